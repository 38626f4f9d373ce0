"""Hands tensors to the Warp kernels without copies."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover.geometry.kernels.start import array
from mover.geometry.raster.records import Asked, Gradients, Items, Maps, Trace


@dataclass(frozen=True)
class Workspace:
    """Working memory, as the kernels and as torch see it."""

    room: tuple[int, int, int, int]
    """Vertices, faces, edges and pixels that fit."""
    scratch: Any
    """`kernels.scene.Scratch`."""
    cuts: Tensor
    targets: Tensor
    count: Tensor

    def fits(self, room: tuple[int, int, int, int]) -> bool:
        """Whether there is so much room."""
        return all(have >= need for have, need in zip(self.room, room, strict=True))


def room_of(items: Items) -> tuple[int, int, int, int]:
    """Vertices, faces, edges and pixels of one item."""
    return items.verts.shape[1], items.faces.shape[1], items.edges.shape[1], items.grid


def desk_of(room: tuple[int, int, int, int], most_cuts: int, device: torch.device) -> Workspace:
    """Working memory that is zero where the kernels expect it."""
    from mover.geometry.kernels.scene import Scratch

    verts, faces, edges, pixels = room
    short = torch.int32
    cuts = torch.empty(most_cuts, 4, dtype=short, device=device)
    targets = torch.empty(most_cuts, dtype=short, device=device)
    number = torch.zeros(2, dtype=short, device=device)
    scratch = Scratch()
    scratch.screen = array(torch.empty(verts, 3, device=device), "vec3")
    scratch.front = array(torch.empty(faces, dtype=torch.int8, device=device), "int8")
    scratch.near, scratch.far = (array(_zeros(pixels, device), "uint64") for _ in range(2))
    scratch.pairs = array(_zeros(2 * pixels, device), "uint64")
    scratch.queue = array(torch.empty(max(edges, faces), dtype=short, device=device), "int32")
    scratch.cuts, scratch.targets = array(cuts, "vec4i"), array(targets, "int32")
    scratch.count = array(number, "int32")
    return Workspace(room, scratch, cuts, targets, number)


def pack_cuts(desk: Workspace, number: int) -> tuple[Tensor, Tensor]:
    """Give a desk room for so many cuts, and return it; no cut has a target, nothing is queued."""
    cuts = torch.empty(number, 4, dtype=torch.int32, device=desk.count.device)
    targets = torch.full((number,), -1, dtype=torch.int32, device=desk.count.device)
    desk.count.zero_()
    desk.scratch.cuts, desk.scratch.targets = array(cuts, "vec4i"), array(targets, "int32")
    return cuts, targets


def _zeros(size: int, device: torch.device) -> Tensor:
    """Zeros that on a CPU take memory only where they are written."""
    if device.type == "cpu":
        return torch.from_numpy(np.zeros(size, dtype=np.int64))
    return torch.zeros(size, dtype=torch.int64, device=device)


def pack_scene(items: Items) -> Any:  # noqa: ANN401
    """`kernels.scene.Scene` of the items."""
    from mover.geometry.kernels.scene import Scene

    scene = Scene()
    scene.verts = array(items.verts.view(-1, 3), "vec3")
    scene.window = array(items.window, "vec4")
    scene.faces = array(items.faces.view(-1, 3), "vec3l")
    scene.edges = array(items.edges.view(-1, 4), "vec4l")
    scene.views, scene.shapes = len(items.window), len(items.faces)
    scene.n_verts, scene.n_faces, scene.n_edges, _ = room_of(items)
    scene.height = items.height + 2 * items.border
    scene.width = items.width + 2 * items.border
    scene.border = items.border
    return scene


def blank(items: Items, asked: Asked) -> tuple[Maps, tuple[Tensor, Tensor, Tensor]]:
    """Maps before anything is drawn; maps of the faces seen first and last; boxes of the items."""
    like, size = items.verts, (len(items.verts), items.height, items.width)
    image, nearest, farthest = (
        like.new_zeros(size if wanted else 0)
        for wanted in (asked.silhouette, asked.depth, asked.depth)
    )
    covered = torch.zeros_like(nearest, dtype=torch.bool)
    near, far = (torch.empty_like(nearest, dtype=torch.int32) for _ in range(2))
    return Maps(image, nearest, farthest, covered), (near, far, box_of(items))


def box_of(items: Items) -> Tensor:
    """Room for the boxes of the items."""
    return torch.empty(len(items.verts), 4, dtype=torch.int32, device=items.verts.device)


def pack_maps(maps: Maps, near_face: Tensor, far_face: Tensor, box: Tensor) -> Any:  # noqa: ANN401
    """`kernels.scene.Maps` of the tensors."""
    from mover.geometry.kernels.scene import Maps as Packed

    packed = Packed()
    packed.image = array(maps.image.view(-1), "float32")
    packed.nearest = array(maps.nearest.view(-1), "float32")
    packed.farthest = array(maps.farthest.view(-1), "float32")
    packed.covered = array(maps.covered.view(-1), "bool")
    packed.near_face = array(near_face.view(-1), "int32")
    packed.far_face = array(far_face.view(-1), "int32")
    packed.box = array(box, "vec4i")
    packed.silhouette, packed.depth = bool(maps.image.numel()), bool(near_face.numel())
    return packed


def pack_pull(trace: Trace, grads: Gradients, verts: Tensor) -> Any:  # noqa: ANN401
    """`kernels.scene.Pull` of the tensors; `verts` is added to."""
    from mover.geometry.kernels.scene import Pull

    pull = Pull()
    pull.cuts = array(trace.cuts, "vec4i")
    pull.targets = array(trace.targets, "int32")
    pull.starts = array(trace.starts, "int32")
    for name, value in vars(grads).items():
        setattr(pull, f"has_{name}", value is not None)
        if value is not None:
            setattr(pull, name, array(value.view(-1), "float32"))
    pull.verts = array(verts.view(-1, 3), "vec3")
    return pull
