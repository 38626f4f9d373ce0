"""Exact-contour silhouettes and depth of many objects at once: the interface of the rasterisers.

The grid of a window has its first pixel centre at (0.5, 0.5). Triangles with a vertex nearer than
`camera.NEAR` are not drawn. The work is done by compiled kernels (`raster.warp`), in single
precision whatever that of the vertices, without a gradient of the intrinsics.
"""

from types import ModuleType

from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.raster import warp
from mover.geometry.raster.engine import reference
from mover.geometry.raster.records import Crops, Depths, Layers, Topology

__all__ = [
    "Crops",
    "Depths",
    "Layers",
    "Topology",
    "depths",
    "first_hit",
    "layers",
    "look",
    "silhouettes",
]


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
    return _drawer(verts_cam).depths(verts_cam, shape, views)


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Crops,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """`silhouettes` and, where asked for, `depths`: both from one pass over the triangles."""
    return _drawer(verts_cam).look(verts_cam, shape, views, depth)


def layers(
    verts_cam: Float[Tensor, "items verts 3"], faces: Int[Tensor, "faces 3"], views: Crops
) -> Layers:
    """Where rays enter closed bodies of one topology and where they first leave them [m].

    `exit` is the nearest back-facing surface. Where a body cuts into itself (a hand in the hip) the
    ray may still be inside another part there: the bound is conservative, never too deep.
    Items are streamed, so memory does not grow with their number but for the result.
    """
    return _drawer(verts_cam).layers(verts_cam, faces, views)


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
    return _drawer(verts_cam).first_hit(verts_cam, faces, K, size)


def _drawer(_verts_cam: Tensor) -> ModuleType:
    """Who draws such vertices."""
    return reference() or warp
