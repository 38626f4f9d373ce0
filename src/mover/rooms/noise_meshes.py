"""Errors of rebuilt meshes: other designs, holes, faces that wind the wrong way."""

import dataclasses

import numpy as np
import torch

from ..furniture import Furniture
from ..furniture.library import another
from ..types import Mesh, Piece
from .noise_config import NoiseConfig

HOLE = 0.1  # share of the surface that is missing where a mesh has a hole


def other_shapes(
    pieces: tuple[Piece, ...],
    furniture: tuple[Furniture, ...],
    noise: NoiseConfig,
    rng: np.random.Generator,
) -> tuple[Piece, ...]:
    """Some meshes replaced by other designs that fill the same box."""
    out: list[Piece] = []
    for piece, known in zip(pieces, furniture, strict=True):
        swap = float(rng.uniform()) < noise.other_shapes
        new = another(known, rng)
        if not swap:
            out.append(piece)
            continue
        ratio = torch.tensor(known.size) / torch.tensor(new.size)
        out.append(dataclasses.replace(piece, mesh=Mesh(new.mesh.verts * ratio, new.mesh.faces)))
    return tuple(out)


def broken(
    pieces: tuple[Piece, ...], noise: NoiseConfig, rng: np.random.Generator
) -> tuple[Piece, ...]:
    """Some meshes with a hole, some turned inside out."""
    out: list[Piece] = []
    for piece in pieces:
        hole, invert = rng.uniform(size=2) < (noise.holes, noise.inverted)
        start = int(rng.integers(len(piece.mesh.faces)))
        mesh = _holed(piece.mesh, start) if hole else piece.mesh
        faces = mesh.faces.flip(1) if invert else mesh.faces
        out.append(dataclasses.replace(piece, mesh=Mesh(mesh.verts, faces)))
    return tuple(out)


def _holed(mesh: Mesh, start: int) -> Mesh:
    """Without the faces nearest to one, at least that one and at most `HOLE` of the surface."""
    corners = mesh.verts[mesh.faces].double()
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = area.norm(dim=-1) / 2
    middle = corners.mean(1)
    order = (middle - middle[start]).norm(dim=-1).argsort(stable=True)
    gone = order[: max(1, int((area[order].cumsum(0) < HOLE * area.sum()).sum()))]
    keep = torch.ones(len(mesh.faces), dtype=torch.bool)
    keep[gone] = False
    return Mesh(mesh.verts, mesh.faces[keep])
