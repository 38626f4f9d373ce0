"""Silhouettes and depth by kernels in NVIDIA Warp: float32, on a CPU or an NVIDIA GPU.

Gradients are in closed form. On a CPU a thread draws one item at a time (`warp_cpu`), so that two
runs give the same bits. On a GPU there is a thread for each vertex, triangle, edge and pixel
(`warp_cuda`).
"""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mover.geometry.kernels.start import kernels, launch, name_of, started
from mover.geometry.raster import warp_cpu, warp_cuda
from mover.geometry.raster.records import (
    BORDER,
    Asked,
    Crops,
    Depths,
    Gradients,
    Items,
    Layers,
    Maps,
    Topology,
)

MOST = 1 << 30  # pixels or vertices of one drawing: the kernels count them in 32 bits


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Crops,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """See `raster.look`."""
    maps = _maps(verts_cam, shape, views, Asked(True, depth))
    return maps.image.to(verts_cam), _depths(maps, verts_cam) if depth else None


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Crops
) -> Depths:
    """See `raster.depths`."""
    return _depths(_maps(verts_cam, shape, views, Asked(False, True)), verts_cam)


def _depths(maps: Maps, like: Tensor) -> Depths:
    return Depths(maps.nearest.to(like), maps.farthest.to(like), maps.covered)


def first_hit(
    verts_cam: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """See `raster.first_hit`."""
    depth = torch.full(size, torch.inf, device=verts_cam.device)
    face = torch.full(size, -1, dtype=torch.int32, device=verts_cam.device)
    if len(verts_cam):
        shape = Topology(faces[None], faces.new_zeros(1, 0, 4))
        items = items_of(verts_cam.float()[None], shape, Crops(K[None], *size), border=0)
        _driver(items).first_hit(items, depth, face)
    return depth.to(verts_cam), face.long()


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Crops
) -> Layers:
    """See `raster.layers`. A call works in one thread and leaves Python's lock to others."""
    wp = started()
    items, n_verts, _ = verts_cam.shape
    points = verts_cam.detach().float().contiguous()
    front = points.new_zeros(items, views.height, views.width)
    leave = torch.full_like(front, -0.0)  # whose inverse is what stands for no exit
    if front.numel() * n_verts * len(faces) > 0:
        K = views.K.to(points)
        window = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2]], -1).contiguous()
        screen = wp.from_torch(torch.empty_like(points), dtype=wp.vec3)
        table = wp.from_torch(faces.to(points.device).long().contiguous(), dtype=wp.vec3l)
        maps = [wp.from_torch(front), wp.from_torch(leave)]
        exits = kernels("exits", name_of(points.device))
        verts = wp.from_torch(points, dtype=wp.vec3)
        windows = wp.from_torch(window, dtype=wp.vec4)
        launch(exits.project, (items, n_verts), [verts, windows, screen], points.device)
        launch(exits.draw, (items, len(faces)), [screen, table, *maps], points.device)
    return Layers(front.reciprocal_().to(verts_cam), leave.reciprocal_().to(verts_cam))


def _maps(verts_cam: Tensor, shape: Topology, views: Crops, asked: Asked) -> Maps:
    """Starts x items as one list, cut where it would be too long to count."""
    *lead, n_verts, _ = verts_cam.shape
    size = (*lead, views.height, views.width)
    flat = verts_cam.float().reshape(-1, n_verts, 3)
    if views.K.requires_grad:
        raise ValueError("raster: the intrinsics have no gradient, found K that requires one")
    if flat.numel() == 0:
        nothing = flat.new_zeros(size)
        return Maps(nothing, nothing, nothing, nothing.bool())
    one = len(views.K)
    most = MOST // max(views.height * views.width, n_verts)
    parts = flat.split(max(one, most // one * one))
    drawn = [_Look.apply(v, items_of(v, shape, views, BORDER), asked) for v in parts]
    image, nearest, farthest, covered = (
        (m[0] if len(m) == 1 else torch.cat(m)) for m in zip(*drawn, strict=True)
    )

    def shaped(flat: Tensor) -> Tensor:
        return flat.view(size) if flat.numel() else flat

    return Maps(shaped(image), shaped(nearest), shaped(farthest), shaped(covered))


def items_of(verts: Tensor, shape: Topology, views: Crops, border: int) -> Items:
    """The inputs as the kernels read them; `border` [px] lies around the windows."""
    K = views.K.to(verts)
    window = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2] + border, K[:, 1, 2] + border], -1)
    edges = shape.edges[:, : None if shape.faces.shape[1] else 0]
    faces, edges = (t.to(verts.device, torch.int64).contiguous() for t in (shape.faces, edges))
    points = verts.detach().contiguous()
    return Items(points, window, faces, edges, views.height, views.width, border)


def _driver(items: Items) -> ModuleType:
    """Who launches the kernels on the device of the items."""
    return warp_cpu if items.verts.device.type == "cpu" else warp_cuda


class _Look(torch.autograd.Function):
    """Maps from vertices, and the gradient of the vertices from those of the maps."""

    @staticmethod
    def forward(ctx: Any, verts: Tensor, items: Items, asked: Asked) -> tuple[Tensor, ...]:  # noqa: ANN401
        maps, ctx.trace = _driver(items).look(items, asked)
        ctx.items = items
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(maps.covered)
        ctx.save_for_backward(verts, maps.nearest, maps.farthest, maps.covered)
        return maps.image, maps.nearest, maps.farthest, maps.covered

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor | None,
    ) -> tuple[Tensor | None, None, None]:
        verts, nearest, farthest, covered = ctx.saved_tensors
        given = Gradients(*(None if g is None else g.contiguous() for g in grads[:3]))
        maps = Maps(nearest.new_zeros(0), nearest, farthest, covered)
        pulled = _driver(ctx.items).pull(ctx.items, maps, ctx.trace, given)
        return pulled.view_as(verts), None, None
