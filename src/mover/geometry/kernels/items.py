"""All stages in a row for a few items, in working memory of one item that stays in the cache.

Threads share nothing, so that results do not depend on their number. Winners are chosen by maxima
of whole keys, whatever the order of the triangles.
"""

import warp as wp

from mover.geometry.kernels.contour import contour, crossing, cut_of, gap, key, pull_cut
from mover.geometry.kernels.scene import Items, MapArrays, Pull, Scratch
from mover.geometry.kernels.spans import fill, on_screen, run_of, signed_area, triangle
from mover.geometry.kernels.surface import pull_pixel, show_pixel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOWHERE, FRONT, BEHIND = 0, 1, 2  # where backs are drawn: with the fronts, or by themselves


@wp.func
def face_at(scene: Items, item: int, f: int) -> wp.vec3l:
    """A triangle of an item."""
    return scene.faces[item % scene.shapes * scene.n_faces + f]


@wp.func
def draw_face(scene: Items, scratch: Scratch, item: int, f: int, backs: int) -> None:
    """Draw a triangle."""
    face = face_at(scene, item, f)
    a = scratch.screen[int(face[0])]
    b = scratch.screen[int(face[1])]
    c = scratch.screen[int(face[2])]
    area = signed_area(a, b, c)
    scratch.front[f] = wp.int8(wp.where(area < 0.0, 1, 0))
    if area < 0.0 or (area > 0.0 and backs != NOWHERE):
        t = triangle(a, b, c, face, wp.vec4i(0, scene.height, 0, scene.width))
        for row in range(t.first, t.last + 1):
            r = run_of(t, row, 0, scene.width)
            if area < 0.0 or backs == FRONT:
                fill(scratch.near, row * scene.width, r, f + 1)
            else:
                fill(scratch.far, row * scene.width, r, -f - 1)


@wp.func
def outline_face(scratch: Scratch, edge: wp.vec4l) -> int:
    """The face of an edge that is drawn as a front where the other is not, else -1."""
    one = scratch.front[int(edge[2])]
    if one == scratch.front[int(edge[3])]:
        return -1
    return int(wp.where(one == wp.int8(1), edge[2], edge[3]))


@wp.func
def enter_cuts(scene: Items, scratch: Scratch, item: int, e: int) -> None:
    """Find the outermost cut for each pair of centres on either side of an edge."""
    edge = scene.edges[item % scene.shapes * scene.n_edges + e]
    f = outline_face(scratch, edge)
    if f >= 0:
        c = contour(scene, scratch, edge, face_at(scene, item, f))
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                if scratch.near[g.inner] != wp.uint64(0) and scratch.near[g.outer] == wp.uint64(0):
                    scratch.pairs[g.pair] = wp.max(scratch.pairs[g.pair], key(g, e))


@wp.func
def keep_cuts(scene: Items, scratch: Scratch, maps: MapArrays, item: int, e: int) -> None:
    """List the cuts of an edge that won, take them out, and move the image by them."""
    edge = scene.edges[item % scene.shapes * scene.n_edges + e]
    f = outline_face(scratch, edge)
    if f >= 0:
        c = contour(scene, scratch, edge, face_at(scene, item, f))
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                if scratch.pairs[g.pair] == key(g, e):
                    scratch.pairs[g.pair] = wp.uint64(0)
                    cut = cut_of(scene, item, c, g, line)
                    x = crossing(scene, cut)
                    n = scratch.count[1]
                    scratch.count[1] = n + 1
                    scratch.cuts[n] = cut
                    scratch.targets[n] = x.target
                    if x.target >= 0:
                        maps.image[x.target] = maps.image[x.target] + x.shift


@wp.func
def bound_cuts(scratch: Scratch, maps: MapArrays, first: int) -> None:
    """Bound the pixels of the cuts from `first` on to [0, 1]; mark those that overshot."""
    for i in range(first, scratch.count[1]):
        target = scratch.targets[i]
        if target >= 0:
            if maps.image[target] < 0.0 or maps.image[target] > 1.0:
                scratch.targets[i] = -2 - target
    for i in range(first, scratch.count[1]):
        target = -2 - scratch.targets[i]
        if target >= 0:
            maps.image[target] = wp.clamp(maps.image[target], 0.0, 1.0)


@wp.func
def show(scene: Items, scratch: Scratch, maps: MapArrays, item: int, row: int) -> None:
    """Write the maps of a row of pixels, and clear their winners."""
    b = scene.border
    high = scene.height - 2 * b
    wide = scene.width - 2 * b
    for column in range(scene.width):
        grid = row * scene.width + column
        near = scratch.near[grid]
        far = scratch.far[grid]
        if (near | far) != wp.uint64(0):
            scratch.near[grid] = wp.uint64(0)
            scratch.far[grid] = wp.uint64(0)
            if row >= b and row < high + b and column >= b and column < wide + b:
                show_pixel(maps, (item * high + row - b) * wide + column - b, near, far)


@wp.func
def draw_item(scene: Items, scratch: Scratch, maps: MapArrays, backs: int, item: int) -> wp.vec2i:
    """Put the triangles of one item into the z-buffers, and find the cuts of its outline.

    Returned are the first row that it may cover and the row after the last.
    """
    low = float(scene.height)
    high = float(0.0)
    for v in range(scene.n_verts):
        s = on_screen(scene.verts[item * scene.n_verts + v], scene.window[item % scene.views])
        scratch.screen[v] = s
        if s[2] > 0.0:
            low = wp.min(low, s[1])
            high = wp.max(high, s[1])
    for f in range(scene.n_faces):
        draw_face(scene, scratch, item, f, backs)
    if maps.silhouette:
        for e in range(scene.n_edges):
            enter_cuts(scene, scratch, item, e)
    return wp.vec2i(int(wp.max(low - 1.0, 0.0)), int(wp.min(high + 1.0, float(scene.height))))


@wp.kernel
def look_items(
    scene: Items, scratch: Scratch, maps: MapArrays, backs: int, first: int, stop: int
) -> None:
    """Silhouettes, depths or hits of some items."""
    for item in range(first, stop):
        rows = draw_item(scene, scratch, maps, backs, item)
        for row in range(rows[0], rows[1]):
            show(scene, scratch, maps, item, row)
        if maps.silhouette:
            begin = scratch.count[1]
            for e in range(scene.n_edges):
                keep_cuts(scene, scratch, maps, item, e)
            bound_cuts(scratch, maps, begin)


@wp.kernel
def pull_items(scene: Items, maps: MapArrays, pull: Pull, first: int, stop: int) -> None:
    """Gradients of the vertices of some items."""
    if pull.has_image:
        for i in range(pull.cuts.shape[0]):
            if pull.targets[i] >= 0:
                pull_cut(scene, pull.cuts[i], pull.image[pull.targets[i]], pull.verts)
    if pull.has_nearest or pull.has_farthest:
        size = (scene.height - 2 * scene.border) * (scene.width - 2 * scene.border)
        for pixel in range(first * size, stop * size):
            pull_pixel(scene, maps, pull, pixel)
