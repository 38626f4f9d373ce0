"""Silhouettes and depth by kernels in NVIDIA Warp: float32, on a CPU or an NVIDIA GPU.

The results are those of `raster_torch`, with gradients in closed form. On a CPU a thread draws one
item at a time (`raster_warp_cpu`), so that two runs give the same bits. On a GPU there is a thread
for each vertex, triangle, edge and pixel (`raster_warp_cuda`).
"""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from . import raster_warp_cpu, raster_warp_cuda
from .raster_engine import DEVICES
from .raster_records import Depths, Topology, Views
from .raster_torch import BORDER
from .raster_warp_records import Asked, Gradients, Items, Maps

MOST = 1 << 30  # pixels or vertices of one drawing: the kernels count them in 32 bits


def draws(verts_cam: Tensor, K: Tensor) -> bool:
    """Whether this engine can draw such vertices: float32, CPU or CUDA, no gradient to `K`."""
    device = verts_cam.device.type in DEVICES
    return device and verts_cam.dtype == torch.float32 and not K.requires_grad


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Views,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """See `raster.look`."""
    maps = _maps(verts_cam, shape, views, Asked(True, depth))
    return maps.image, Depths(maps.nearest, maps.farthest, maps.covered) if depth else None


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Views
) -> Depths:
    """See `raster.depths`."""
    maps = _maps(verts_cam, shape, views, Asked(False, True))
    return Depths(maps.nearest, maps.farthest, maps.covered)


def first_hit(
    verts_cam: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """See `raster.first_hit`."""
    depth = verts_cam.new_full(size, torch.inf)
    face = torch.full(size, -1, dtype=torch.int32, device=verts_cam.device)
    if len(verts_cam):
        shape = Topology(faces[None], faces.new_zeros(1, 0, 4))
        items = items_of(verts_cam[None], shape, Views(K[None], *size), border=0)
        _driver(items).first_hit(items, depth, face)
    return depth, face.long()


def _maps(verts_cam: Tensor, shape: Topology, views: Views, asked: Asked) -> Maps:
    """Starts x items as one list, cut where it would be too long to count."""
    *lead, n_verts, _ = verts_cam.shape
    size = (*lead, views.height, views.width)
    flat = verts_cam.reshape(-1, n_verts, 3)
    if flat.numel() == 0:
        nothing = verts_cam.new_zeros(size)
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


def items_of(verts: Tensor, shape: Topology, views: Views, border: int) -> Items:
    """The inputs as the kernels read them; `border` [px] lies around the windows."""
    K = views.K.to(verts)
    window = torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2] + border, K[:, 1, 2] + border], -1)
    edges = shape.edges[:, : None if shape.faces.shape[1] else 0]
    faces, edges = (t.to(verts.device, torch.int64).contiguous() for t in (shape.faces, edges))
    points = verts.detach().contiguous()
    return Items(points, window, faces, edges, views.height, views.width, border)


def _driver(items: Items) -> ModuleType:
    """Who launches the kernels on the device of the items."""
    return raster_warp_cpu if items.verts.device.type == "cpu" else raster_warp_cuda


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
