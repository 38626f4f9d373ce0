"""Exact-contour silhouettes and depth of many objects at once.

The grid of a window has its first pixel centre at (0.5, 0.5). Triangles with a vertex nearer than
`camera.NEAR` are not drawn. The work is done by kernels in NVIDIA Warp on the CPU (vertices on a
GPU are copied there, the maps back), in single precision whatever that of the vertices, with
gradients in closed form but none of the intrinsics. Two runs give the same bits.
"""

from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mover.geometry.raster import draw
from mover.geometry.raster.draw import Crops, Depths, Layers, Maps, Topology

__all__ = [
    "Crops", "Depths", "Layers", "Topology",
    "depths", "first_hit", "layers", "look", "silhouettes",
]  # fmt: skip

MOST = 1 << 30  # pixels or vertices of one drawing: the kernels count them in 32 bits


def _reference_of(_verts_cam: Tensor) -> ModuleType | None:
    """What draws such vertices in place of the kernels: plain torch in tests."""
    return None


def silhouettes(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Crops
) -> Float[Tensor, "*starts items h w"]:
    """Share of each pixel that an object covers, in [0, 1], differentiable in the vertices [m].

    Pixel centres are tested hard; where the outline passes between a covered and an uncovered
    centre, its place in between moves one of the two pixels by up to a half. The gradient is the
    boundary integral of the outline's motion, sampled on the lines through the centres. Parts
    thinner than a pixel are seen only where they hold a centre.
    """
    return look(verts_cam, shape, views, depth=False)[0]


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Crops
) -> Depths:
    """First and last surface [m], differentiable in the vertices of the triangle that is seen.

    The outline's motion has no share in the gradient (`silhouettes` has it). A triangle seen at
    less than half a degree gives a depth but no gradient, which would be without bound.
    """
    if reference := _reference_of(verts_cam):
        return reference.depths(verts_cam, shape, views)
    return _depths(_maps(verts_cam, shape, views, (False, True)), verts_cam)


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Crops,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """`silhouettes` and, where asked for, `depths`: both from one pass over the triangles."""
    if reference := _reference_of(verts_cam):
        return reference.look(verts_cam, shape, views, depth)
    maps = _maps(verts_cam, shape, views, (True, depth))
    return maps.image.to(verts_cam), _depths(maps, verts_cam) if depth else None


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Crops
) -> Layers:
    """Where rays enter closed bodies of one topology and where they first leave them [m].

    `exit` is the nearest back-facing surface. Where a body cuts into itself (a hand in the hip) the
    ray may still be inside another part there: the bound is conservative, never too deep.
    """
    back = fronts(verts_cam, faces.flip(-1), views)  # backs drawn as fronts
    return Layers(fronts(verts_cam, faces, views), torch.where(back < torch.inf, back, -torch.inf))


def fronts(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Crops
) -> Float[Tensor, "items h w"]:
    """Where rays enter closed bodies of one topology [m]; inf where they miss."""
    return _nearest(verts_cam, faces, views, draw.NOWHERE)[0]


def first_hit(
    verts_cam: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Depth [m] (inf: none) and face (-1: none) that each pixel sees, whatever the winding.

    The size is height and width [px]; triangles need not be closed or consistent.
    """
    depth, face = _nearest(verts_cam[None], faces, Crops(K[None], *size), draw.FRONT)
    return depth[0], face[0].long()


def _nearest(
    verts_cam: Tensor, faces: Tensor, views: Crops, backs: int
) -> tuple[Float[Tensor, "items h w"], Int[Tensor, "items h w"]]:
    """First surfaces of items of one topology, a list that is cut where it is too long."""
    points = verts_cam.detach().float().cpu()
    size = (len(points), views.height, views.width)
    most = max(1, MOST // max(views.height * views.width, points.shape[1], 1))
    shape = Topology(faces[None], faces.new_zeros(1, 0, 4))
    depth, face = torch.full(size, torch.inf), torch.full(size, -1, dtype=torch.int32)
    for k in range(0, len(points) if points.shape[1] and len(faces) else 0, most):
        some, part = slice(k, k + most), Crops(views.K[k : k + most], *size[1:])
        draw.first_hit(points[some], shape, part, depth[some], face[some], backs)
    return depth.to(verts_cam), face.to(verts_cam.device)


def _depths(maps: Maps, like: Tensor) -> Depths:
    return Depths(maps.nearest.to(like), maps.farthest.to(like), maps.covered.to(like.device))


def _maps(verts_cam: Tensor, shape: Topology, views: Crops, asked: tuple[bool, bool]) -> Maps:
    """Silhouettes and depths of starts x items, a list that is cut where it is too long."""
    *lead, n_verts, _ = verts_cam.shape
    size = (*lead, views.height, views.width)
    flat = verts_cam.float().cpu().reshape(-1, n_verts, 3)
    if views.K.requires_grad:
        raise ValueError("raster: the intrinsics have no gradient, found K that requires one")
    if flat.numel() == 0:
        nothing = flat.new_zeros(size)
        return Maps(nothing, nothing, nothing, nothing.bool())
    one = len(views.K)
    most = MOST // max(views.height * views.width, n_verts)
    parts = flat.split(max(one, most // one * one))
    drawn = [_Look.apply(v, shape, views, *asked) for v in parts]
    maps = (m[0] if len(m) == 1 else torch.cat(m) for m in zip(*drawn, strict=True))
    return Maps(*(m.view(size) if m.numel() else m for m in maps))


class _Look(torch.autograd.Function):
    """Maps from vertices, and the gradient of the vertices from those of the maps."""

    @staticmethod
    def forward(ctx: Any, *given: Any) -> tuple[Tensor, ...]:  # noqa: ANN401
        maps, ctx.trace = draw.look(*given)
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(maps.covered)
        ctx.save_for_backward(given[0], maps.nearest, maps.farthest, maps.covered)
        return maps.image, maps.nearest, maps.farthest, maps.covered

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        verts, nearest, farthest, covered = ctx.saved_tensors
        maps = Maps(verts.new_zeros(0), nearest, farthest, covered)
        pulled = verts.new_zeros(verts.shape)
        names = ("image", "nearest", "farthest")
        named: dict[str, Tensor | None] = dict(zip(names, grads, strict=False))
        draw.pull(maps, ctx.trace, named, pulled)
        return pulled, None, None, None, None
