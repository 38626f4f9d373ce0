"""Exact-contour silhouettes and depth of many objects at once: the interface of the rasterisers.

The grid of a window has its first pixel centre at (0.5, 0.5). Triangles with a vertex nearer than
`camera.NEAR` are not drawn. The work is done by `raster_warp` (compiled kernels) or by
`raster_torch` (any device, any precision): see `raster_engine`.
"""

from types import ModuleType

from jaxtyping import Float, Int
from torch import Tensor

from . import layers_warp, raster_torch, raster_warp
from .raster_engine import engine
from .raster_records import Depths, Layers, Topology, Views

__all__ = [
    "Depths",
    "Layers",
    "Topology",
    "Views",
    "depths",
    "first_hit",
    "layers",
    "look",
    "silhouettes",
]


def silhouettes(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Views
) -> Float[Tensor, "*starts items h w"]:
    """Share of each pixel that an object covers, in [0, 1], differentiable in the vertices [m].

    Pixel centres are tested hard; where the outline passes between a covered and an uncovered
    centre, its place in between moves one of the two pixels by up to a half. The gradient is the
    boundary integral of the outline's motion, sampled on the lines through the centres. Parts
    thinner than a pixel are seen only where they hold a centre.
    """
    return look(verts_cam, shape, views, depth=False)[0]


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Views
) -> Depths:
    """First and last surface [m], differentiable in the vertices of the triangle that is seen.

    The outline's motion has no share in the gradient (`silhouettes` has it). A triangle seen at
    less than half a degree gives a depth but no gradient, which would be without bound.
    """
    return _drawer(verts_cam, views.K).depths(verts_cam, shape, views)


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Views,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """`silhouettes` and, where asked for, `depths`: both from one pass over the triangles."""
    return _drawer(verts_cam, views.K).look(verts_cam, shape, views, depth)


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Views
) -> Layers:
    """Where rays enter closed bodies of one topology and where they first leave them [m].

    `exit` is the nearest back-facing surface. Where a body cuts into itself (a hand in the hip) the
    ray may still be inside another part there: the bound is conservative, never too deep.
    Items are streamed, so memory does not grow with their number but for the result.
    """
    draw = layers_warp.layers if engine() == "warp" else raster_torch.layers
    return draw(verts_cam, faces, views)


def first_hit(
    verts_cam: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w"], Int[Tensor, "h w"]]:
    """Depth [m] (inf: none) and face (-1: none) that each pixel sees, whatever the winding.

    Args:
        verts_cam: Vertices in camera axes [m].
        faces: Triangles, not necessarily closed or consistent.
        K: Intrinsics [px].
        size: Height and width [px].
    """
    return _drawer(verts_cam, K).first_hit(verts_cam, faces, K, size)


def _drawer(verts_cam: Tensor, K: Tensor) -> ModuleType:
    """Who draws: Warp if it is the engine and can (float32, CPU or CUDA), else torch."""
    warp = engine() == "warp" and raster_warp.draws(verts_cam, K)
    return raster_warp if warp else raster_torch
