"""All stages in a row for a few items, in working memory of one that stays in the cache: for CPUs.

Threads share nothing, so that results do not depend on their number.
"""

import warp as wp

from mover.geometry.kernels.contour import pull_cut
from mover.geometry.kernels.grid import (
    bound_cut,
    draw_face,
    enter_cuts,
    keep_cuts,
    mark_cut,
    place_vert,
    show,
)
from mover.geometry.kernels.scene import Maps, Pull, Scene, Scratch
from mover.geometry.kernels.surface import pull_pixel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def draw_item(scene: Scene, scratch: Scratch, maps: Maps, backs: int, at: wp.vec2i) -> wp.vec2i:
    """Put the triangles of one item into the z-buffers, and find the cuts of its outline.

    Returns:
        The first row that it may cover and the row after the last.
    """
    low = float(scene.height)
    high = float(0.0)
    for v in range(scene.n_verts):
        s = place_vert(scene, scratch, at, v)
        if s[2] > 0.0:
            low = wp.min(low, s[1])
            high = wp.max(high, s[1])
    for f in range(scene.n_faces):
        draw_face(scene, scratch, at, f, backs, scene.height)
    if maps.silhouette:
        for e in range(scene.n_edges):
            enter_cuts(scene, scratch, at, e)
    return wp.vec2i(int(wp.max(low - 1.0, 0.0)), int(wp.min(high + 1.0, float(scene.height))))


@wp.func
def bound_item(scene: Scene, scratch: Scratch, maps: Maps, at: wp.vec2i) -> None:
    """Move the silhouette of one item by its outline."""
    first = scratch.count[1]
    for e in range(scene.n_edges):
        keep_cuts(scene, scratch, maps, at, e)
    for i in range(first, scratch.count[1]):
        mark_cut(scratch, maps, i)
    for i in range(first, scratch.count[1]):
        bound_cut(scratch, maps, i)


@wp.kernel
def look_items(
    scene: Scene, scratch: Scratch, maps: Maps, backs: int, first: int, stop: int
) -> None:
    """Silhouettes, depths or hits of some items."""
    for item in range(first, stop):
        at = wp.vec2i(item, 0)
        rows = draw_item(scene, scratch, maps, backs, at)
        for row in range(rows[0], rows[1]):
            for column in range(scene.width):
                show(scene, scratch, maps, at, row, column)
        if maps.silhouette:
            bound_item(scene, scratch, maps, at)


@wp.kernel
def pull_items(scene: Scene, maps: Maps, pull: Pull, first: int, stop: int) -> None:
    """Gradients of the vertices of some items."""
    if pull.has_image:
        for i in range(pull.cuts.shape[0]):
            if pull.targets[i] >= 0:
                pull_cut(scene, pull.cuts[i], pull.image[pull.targets[i]], pull.verts)
    if pull.has_nearest or pull.has_farthest:
        size = (scene.height - 2 * scene.border) * (scene.width - 2 * scene.border)
        for pixel in range(first * size, stop * size):
            pull_pixel(scene, maps, pull, pixel)
