"""Soles of a mesh that is no whole human body: what lies lowest and faces down."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..geometry.mesh import vertex_normals
from .part_names import PARTS

HEIGHT = 0.03
"""A sole is that near the lowest point [heights of the mesh]."""


def lowest_soles(
    meshes: Float[Tensor, "meshes verts 3"],
    faces: Int[Tensor, "faces 3"],
    up: Float[Tensor, "3"],
) -> Int[Tensor, " verts"]:
    """Index into `PARTS` (a sole) or -1 of each vertex; sides are told apart by place only."""
    height = meshes @ up
    low, high = height.amin(1, keepdim=True), height.amax(1, keepdim=True)
    near = height < low + HEIGHT * (high - low)
    down = vertex_normals(meshes, faces) @ up < -0.6
    sole = (near & down).double().mean(0) >= 0.5
    part = torch.full((meshes.shape[1],), -1)
    if sole.any():
        points = meshes[0, sole] - up * (meshes[0, sole] @ up)[:, None]
        points = points - (points.amax(0) + points.amin(0)) / 2
        widest = torch.linalg.eigh(points.T @ points).eigenvectors[:, -1]
        first, second = PARTS.index("left_sole"), PARTS.index("right_sole")
        part[sole] = torch.where(points @ widest > 0, first, second)
    return part
