# pyright: basic, reportInvalidTypeForm=false
"""One thread for each item: all stages in a row, in working memory that stays in the cache.

Threads share nothing, so that results do not depend on their number.
"""

from typing import no_type_check

import warp as wp

from mover.geometry.kernels.contour import contour, crossing, cut_of, gap, key, pull_cut
from mover.geometry.kernels.scene import Maps, Pull, Scene, Scratch
from mover.geometry.kernels.spans import on_screen, paint, signed_area, triangle
from mover.geometry.kernels.surface import face_of, inverse_depth, pixel_of, pull_pixel, show_pixel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOWHERE, NEAR, FAR = 0, 1, 2  # buffers for the backs
SLACK = 3.0  # [px] around an item that its outline may touch
ROUNDING = 1e-6  # share of the largest column by which a cut can be off


@wp.func
@no_type_check
def project(scene: Scene, scratch: Scratch, item: int) -> wp.vec4i:
    """Put the vertices on the screen.

    Returns:
        First row, row after the last, first column, column after the last that can be touched.
    """
    low = wp.vec2(1.0e9, 1.0e9)
    high = wp.vec2(-1.0e9, -1.0e9)
    k = scene.window[item % scene.views]
    base = item * scene.n_verts
    for v in range(scene.n_verts):
        s = on_screen(scene.verts[base + v], k)
        scratch.screen[v] = s
        if s[2] > 0.0:
            low = wp.min(low, wp.vec2(s[0], s[1]))
            high = wp.max(high, wp.vec2(s[0], s[1]))
    height = float(scene.height)
    width = float(scene.width)
    slack = SLACK + ROUNDING * wp.max(wp.abs(low[0]), wp.abs(high[0]))
    return wp.vec4i(
        int(wp.clamp(low[1] - SLACK, 0.0, height)),
        int(wp.clamp(high[1] + SLACK, 0.0, height)),
        int(wp.clamp(low[0] - slack, 0.0, width)),
        int(wp.clamp(high[0] + slack, 0.0, width)),
    )


@wp.func
@no_type_check
def draw(scene: Scene, scratch: Scratch, item: int, backs: int) -> None:
    """Draw the fronts, where the nearest wins, to `near`.

    Args:
        scene: Items.
        scratch: Working memory of this item.
        item: Number of the item.
        backs: Where the backs are drawn: NOWHERE, to FAR, or NEAR, like the fronts.
    """
    base = item % scene.shapes * scene.n_faces
    for f in range(scene.n_faces):
        face = scene.faces[base + f]
        a = scratch.screen[int(face[0])]
        b = scratch.screen[int(face[1])]
        c = scratch.screen[int(face[2])]
        area = signed_area(a, b, c)
        scratch.front[f] = wp.int8(wp.where(area < 0.0, 1, 0))
        if area < 0.0 or (area > 0.0 and backs != NOWHERE):
            t = triangle(a, b, c, face, scene.height)
            near = area < 0.0 or backs == NEAR
            row = t.first
            while row <= t.last:
                paint(scene, scratch, t, wp.vec3i(0, row, f), near)
                row += 1


@wp.func
@no_type_check
def enter_cuts(scene: Scene, scratch: Scratch, item: int) -> None:
    """Find the outline, and of each pair of centres the outermost cut."""
    n = int(0)
    e_base = item % scene.shapes * scene.n_edges
    f_base = item % scene.shapes * scene.n_faces
    for e in range(scene.n_edges):
        edge = scene.edges[e_base + e]
        one = scratch.front[int(edge[2])]
        if one != scratch.front[int(edge[3])]:
            scratch.queue[n] = e
            n += 1
            face = int(wp.where(one == wp.int8(1), edge[2], edge[3]))
            c = contour(scene, scratch, 0, edge, scene.faces[f_base + face])
            for line in range(c.first, c.last + 1):
                g = gap(scene, c, line)
                if g.distance >= 0.0:
                    if scratch.near[g.inner] != wp.uint64(0) and scratch.near[g.outer] == wp.uint64(
                        0
                    ):
                        wp.atomic_max(scratch.pairs, g.pair, key(g, e))
    scratch.count[0] = n


@wp.func
@no_type_check
def keep_cuts(scene: Scene, scratch: Scratch, maps: Maps, item: int) -> None:
    """List the cuts that won and move the image by them."""
    n = int(0)
    e_base = item % scene.shapes * scene.n_edges
    f_base = item % scene.shapes * scene.n_faces
    for i in range(scratch.count[0]):
        e = scratch.queue[i]
        edge = scene.edges[e_base + e]
        face = int(wp.where(scratch.front[int(edge[2])] == wp.int8(1), edge[2], edge[3]))
        c = contour(scene, scratch, 0, edge, scene.faces[f_base + face])
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                if scratch.pairs[g.pair] == key(g, e):
                    scratch.pairs[g.pair] = wp.uint64(0)
                    cut = cut_of(scene, item, c, g, line)
                    x = crossing(scene, cut)
                    if x.target >= 0:
                        scratch.cuts[n] = cut
                        scratch.targets[n] = x.target
                        n += 1
                        maps.image[x.target] = maps.image[x.target] + x.shift
    scratch.count[1] = n


@wp.func
@no_type_check
def clamp_cuts(scratch: Scratch, maps: Maps) -> None:
    """Bound the moved pixels to [0, 1], and mark the cuts of those that were outside."""
    for i in range(scratch.count[1]):
        target = scratch.targets[i]
        if maps.image[target] < 0.0 or maps.image[target] > 1.0:
            scratch.targets[i] = -1 - target
    for i in range(scratch.count[1]):
        target = scratch.targets[i]
        if target < 0:
            maps.image[-1 - target] = wp.clamp(maps.image[-1 - target], 0.0, 1.0)


@wp.func
@no_type_check
def show(scene: Scene, scratch: Scratch, maps: Maps, item: int, box: wp.vec4i) -> None:
    """Write the maps from the winners of the pixels in the box, and clear these."""
    b = scene.border
    for row in range(box[0], box[1]):
        start = pixel_of(scene, item, row, 0)
        seen = row >= b and row < scene.height - b
        for column in range(box[2], box[3]):
            grid = row * scene.width + column
            near = scratch.near[grid]
            far = scratch.far[grid]
            if (near | far) != wp.uint64(0):
                scratch.near[grid] = wp.uint64(0)
                scratch.far[grid] = wp.uint64(0)
                if seen and column >= b and column < scene.width - b:
                    show_pixel(maps, start + column, near, far)


@wp.kernel
@no_type_check
def look_item(scene: Scene, scratch: Scratch, maps: Maps, item: int) -> None:
    """Silhouette and depths of one item."""
    box = project(scene, scratch, item)
    maps.box[item] = box
    draw(scene, scratch, item, wp.where(maps.depth, FAR, NOWHERE))
    if maps.silhouette:
        enter_cuts(scene, scratch, item)
    show(scene, scratch, maps, item, box)
    if maps.silhouette:
        keep_cuts(scene, scratch, maps, item)
        clamp_cuts(scratch, maps)


@wp.kernel
@no_type_check
def pull_item(scene: Scene, maps: Maps, pull: Pull, item: int) -> None:
    """Gradients of the vertices of one item."""
    if pull.has_image:
        for i in range(pull.starts[item], pull.starts[item + 1]):
            if pull.targets[i] >= 0:
                pull_cut(scene, pull.cuts[i], pull.image[pull.targets[i]], pull.verts)
    if pull.has_nearest or pull.has_farthest:
        b = scene.border
        box = maps.box[item]
        for row in range(wp.max(box[0], b), wp.min(box[1], scene.height - b)):
            start = pixel_of(scene, item, row, 0)
            for column in range(wp.max(box[2], b), wp.min(box[3], scene.width - b)):
                pull_pixel(scene, maps, pull, start + column)


@wp.kernel
@no_type_check
def hit_item(scene: Scene, scratch: Scratch, maps: Maps, item: int) -> None:
    """Nearest surface of one item, whatever its winding."""
    box = project(scene, scratch, item)
    draw(scene, scratch, item, NEAR)
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            grid = row * scene.width + column
            near = scratch.near[grid]
            if near != wp.uint64(0):
                pixel = pixel_of(scene, item, row, column)
                maps.nearest[pixel] = 1.0 / inverse_depth(near, False)
                maps.near_face[pixel] = face_of(near)
                scratch.near[grid] = wp.uint64(0)
