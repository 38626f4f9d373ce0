# pyright: basic, reportInvalidTypeForm=false
"""One thread for each vertex, triangle, edge or pixel; triangles of many rows get many threads.

Winners are chosen by atomic maxima of whole keys, whatever the order of the threads; sums of
gradients, and of cuts that move one pixel, are made in any order.
"""

from typing import no_type_check

import warp as wp

from mover.geometry.kernels.contour import contour, crossing, cut_of, gap, key, pull_cut
from mover.geometry.kernels.items import NEAR, NOWHERE
from mover.geometry.kernels.scene import Maps, Pull, Scene, Scratch
from mover.geometry.kernels.spans import Triangle, on_screen, paint, signed_area, triangle
from mover.geometry.kernels.surface import face_of, inverse_depth, pull_pixel, show_pixel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TALL = 16  # rows above which a triangle is shared


@wp.kernel
@no_type_check
def project(scene: Scene, scratch: Scratch) -> None:
    """Put a vertex on the screen."""
    v = wp.tid()
    item = v / scene.n_verts
    scratch.screen[v] = on_screen(scene.verts[v], scene.window[item % scene.views])


@wp.func
@no_type_check
def area_of(scene: Scene, scratch: Scratch, item: int, face: wp.vec3l) -> float:
    """Twice the signed area of a triangle [px²]."""
    base = item * scene.n_verts
    return signed_area(
        scratch.screen[base + int(face[0])],
        scratch.screen[base + int(face[1])],
        scratch.screen[base + int(face[2])],
    )


@wp.func
@no_type_check
def triangle_of(scene: Scene, scratch: Scratch, item: int, face: wp.vec3l) -> Triangle:
    """A triangle and its rows."""
    base = item * scene.n_verts
    return triangle(
        scratch.screen[base + int(face[0])],
        scratch.screen[base + int(face[1])],
        scratch.screen[base + int(face[2])],
        face,
        scene.height,
    )


@wp.kernel
@no_type_check
def draw(scene: Scene, scratch: Scratch, backs: int) -> None:
    """Draw a triangle, or queue it where it has many rows; `backs` as in `items.draw`."""
    item, f = wp.tid()
    face = scene.faces[item % scene.shapes * scene.n_faces + f]
    area = area_of(scene, scratch, item, face)
    scratch.front[item * scene.n_faces + f] = wp.int8(wp.where(area < 0.0, 1, 0))
    if area < 0.0 or (area > 0.0 and backs != NOWHERE):
        t = triangle_of(scene, scratch, item, face)
        if t.last - t.first >= TALL:
            scratch.queue[wp.atomic_add(scratch.count, 0, 1)] = item * scene.n_faces + f
        else:
            near = area < 0.0 or backs == NEAR
            row = t.first
            while row <= t.last:
                paint(scene, scratch, t, wp.vec3i(item, row, f), near)
                row += 1


@wp.kernel
@no_type_check
def draw_tall(scene: Scene, scratch: Scratch, backs: int, lanes: int) -> None:
    """Draw rows of the queued triangles, each thread every so many."""
    work = wp.tid()
    while work < scratch.count[0] * scene.height:
        queued = scratch.queue[work / scene.height]
        item = queued / scene.n_faces
        f = queued % scene.n_faces
        face = scene.faces[item % scene.shapes * scene.n_faces + f]
        t = triangle_of(scene, scratch, item, face)
        row = t.first + work % scene.height
        if row <= t.last:
            near = backs == NEAR or area_of(scene, scratch, item, face) < 0.0
            paint(scene, scratch, t, wp.vec3i(item, row, f), near)
        work += lanes


@wp.func
@no_type_check
def outline_face(scene: Scene, scratch: Scratch, item: int, edge: wp.vec4l) -> int:
    """The face of an edge that is drawn as a front where the other is not, else -1."""
    base = item * scene.n_faces
    one = scratch.front[base + int(edge[2])]
    if one == scratch.front[base + int(edge[3])]:
        return -1
    return int(wp.where(one == wp.int8(1), edge[2], edge[3]))


@wp.kernel
@no_type_check
def enter_cuts(scene: Scene, scratch: Scratch) -> None:
    """Find, for each pair of centres, the outermost cut."""
    item, e = wp.tid()
    edge = scene.edges[item % scene.shapes * scene.n_edges + e]
    f = outline_face(scene, scratch, item, edge)
    if f >= 0:
        face = scene.faces[item % scene.shapes * scene.n_faces + f]
        c = contour(scene, scratch, item, edge, face)
        base = item * scene.height * scene.width
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                inner = scratch.near[base + g.inner]
                outer = scratch.near[base + g.outer]
                if inner != wp.uint64(0) and outer == wp.uint64(0):
                    wp.atomic_max(scratch.pairs, 2 * base + g.pair, key(g, e))


@wp.kernel
@no_type_check
def keep_cuts(scene: Scene, scratch: Scratch, maps: Maps) -> None:
    """List the cuts that won and move the image by them."""
    item, e = wp.tid()
    edge = scene.edges[item % scene.shapes * scene.n_edges + e]
    f = outline_face(scene, scratch, item, edge)
    if f >= 0:
        face = scene.faces[item % scene.shapes * scene.n_faces + f]
        c = contour(scene, scratch, item, edge, face)
        base = 2 * item * scene.height * scene.width
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                if scratch.pairs[base + g.pair] == key(g, e):
                    cut = cut_of(scene, item, c, g, line)
                    x = crossing(scene, cut)
                    n = wp.atomic_add(scratch.count, 0, 1)
                    scratch.cuts[n] = cut
                    scratch.targets[n] = x.target
                    if x.target >= 0:
                        wp.atomic_add(maps.image, x.target, x.shift)


@wp.kernel
@no_type_check
def show(scene: Scene, scratch: Scratch, maps: Maps) -> None:
    """Write the maps of a pixel."""
    item, row, column = wp.tid()
    b = scene.border
    grid = (item * scene.height + row + b) * scene.width + column + b
    pixel = (item * (scene.height - 2 * b) + row) * (scene.width - 2 * b) + column
    show_pixel(maps, pixel, scratch.near[grid], scratch.far[grid])


@wp.kernel
@no_type_check
def show_hits(scratch: Scratch, maps: Maps) -> None:
    """Write the nearest surface of a pixel, whatever its winding."""
    pixel = wp.tid()
    near = scratch.near[pixel]
    if near != wp.uint64(0):
        maps.nearest[pixel] = 1.0 / inverse_depth(near, False)
        maps.near_face[pixel] = face_of(near)


@wp.kernel
@no_type_check
def mark_cuts(scratch: Scratch, maps: Maps) -> None:
    """Mark a cut whose pixel is outside [0, 1], before any is bounded."""
    i = wp.tid()
    target = scratch.targets[i]
    if target >= 0:
        if maps.image[target] < 0.0 or maps.image[target] > 1.0:
            scratch.targets[i] = -2 - target


@wp.kernel
@no_type_check
def bound_cuts(scratch: Scratch, maps: Maps) -> None:
    """Bound the pixel of a marked cut to [0, 1]."""
    target = -2 - scratch.targets[wp.tid()]
    if target >= 0:
        maps.image[target] = wp.clamp(maps.image[target], 0.0, 1.0)


@wp.kernel
@no_type_check
def pull_cuts(scene: Scene, pull: Pull) -> None:
    """Gradient of one cut."""
    i = wp.tid()
    if pull.targets[i] >= 0:
        pull_cut(scene, pull.cuts[i], pull.image[pull.targets[i]], pull.verts)


@wp.kernel
@no_type_check
def pull_pixels(scene: Scene, maps: Maps, pull: Pull) -> None:
    """Gradient of the depths of one pixel."""
    pull_pixel(scene, maps, pull, wp.tid())
