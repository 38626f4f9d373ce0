"""What is done for each vertex, triangle, edge, pixel or cut, and a thread for each: for GPUs.

Winners are chosen by atomic maxima of whole keys, whatever the order of the threads; sums of
gradients, and of cuts that move one pixel, are made in any order. Triangles of many rows get many
threads. An item is told by two numbers, `at`: its own, and that of its place in `Scratch`.
"""

import warp as wp

from mover.geometry.kernels.contour import contour, crossing, cut_of, gap, key, pull_cut
from mover.geometry.kernels.scene import Maps, Pull, Scene, Scratch
from mover.geometry.kernels.spans import Triangle, on_screen, paint, signed_area, triangle
from mover.geometry.kernels.surface import pull_pixel, show_pixel

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOWHERE, FRONT, BEHIND = 0, 1, 2  # where backs are drawn: with the fronts, or by themselves
TALL = 16  # rows above which a triangle is shared
LANES = 1 << 16  # threads that share the triangles of many rows


@wp.func
def place_vert(scene: Scene, scratch: Scratch, at: wp.vec2i, v: int) -> wp.vec3:
    """Put a vertex on the screen."""
    p = scene.verts[at[0] * scene.n_verts + v]
    s = on_screen(p, scene.window[at[0] % scene.views])
    scratch.screen[at[1] * scene.n_verts + v] = s
    return s


@wp.func
def face_at(scene: Scene, at: wp.vec2i, f: int) -> wp.vec3l:
    """A triangle of an item."""
    return scene.faces[at[0] % scene.shapes * scene.n_faces + f]


@wp.func
def area_of(scene: Scene, scratch: Scratch, at: wp.vec2i, face: wp.vec3l) -> float:
    """Twice the signed area of a triangle [px²]."""
    base = at[1] * scene.n_verts
    return signed_area(
        scratch.screen[base + int(face[0])],
        scratch.screen[base + int(face[1])],
        scratch.screen[base + int(face[2])],
    )


@wp.func
def triangle_of(scene: Scene, scratch: Scratch, at: wp.vec2i, face: wp.vec3l) -> Triangle:
    """A triangle and its rows."""
    base = at[1] * scene.n_verts
    return triangle(
        scratch.screen[base + int(face[0])],
        scratch.screen[base + int(face[1])],
        scratch.screen[base + int(face[2])],
        face,
        wp.vec4i(0, scene.height, 0, scene.width),
    )


@wp.func
def draw_face(scene: Scene, scratch: Scratch, at: wp.vec2i, f: int, backs: int, most: int) -> bool:
    """Draw a triangle unless it has more rows than `most`; whether that is done."""
    face = face_at(scene, at, f)
    area = area_of(scene, scratch, at, face)
    scratch.front[at[1] * scene.n_faces + f] = wp.int8(wp.where(area < 0.0, 1, 0))
    if area < 0.0 or (area > 0.0 and backs != NOWHERE):
        t = triangle_of(scene, scratch, at, face)
        if t.last - t.first >= most:
            return False
        near = area < 0.0 or backs == FRONT
        row = t.first
        while row <= t.last:
            paint(scene, scratch, t, wp.vec3i(at[1], row, f), near)
            row += 1
    return True


@wp.func
def outline_face(scene: Scene, scratch: Scratch, at: wp.vec2i, edge: wp.vec4l) -> int:
    """The face of an edge that is drawn as a front where the other is not, else -1."""
    base = at[1] * scene.n_faces
    one = scratch.front[base + int(edge[2])]
    if one == scratch.front[base + int(edge[3])]:
        return -1
    return int(wp.where(one == wp.int8(1), edge[2], edge[3]))


@wp.func
def enter_cuts(scene: Scene, scratch: Scratch, at: wp.vec2i, e: int) -> None:
    """Find, for each pair of centres that an edge parts, the outermost cut."""
    edge = scene.edges[at[0] % scene.shapes * scene.n_edges + e]
    f = outline_face(scene, scratch, at, edge)
    if f >= 0:
        c = contour(scene, scratch, at[1], edge, face_at(scene, at, f))
        base = at[1] * scene.height * scene.width
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                inner = scratch.near[base + g.inner]
                outer = scratch.near[base + g.outer]
                if inner != wp.uint64(0) and outer == wp.uint64(0):
                    wp.atomic_max(scratch.pairs, 2 * base + g.pair, key(g, e))


@wp.func
def keep_cuts(scene: Scene, scratch: Scratch, maps: Maps, at: wp.vec2i, e: int) -> None:
    """List the cuts of an edge that won, take them out, and move the image by them."""
    edge = scene.edges[at[0] % scene.shapes * scene.n_edges + e]
    f = outline_face(scene, scratch, at, edge)
    if f >= 0:
        c = contour(scene, scratch, at[1], edge, face_at(scene, at, f))
        base = 2 * at[1] * scene.height * scene.width
        for line in range(c.first, c.last + 1):
            g = gap(scene, c, line)
            if g.distance >= 0.0:
                if scratch.pairs[base + g.pair] == key(g, e):
                    scratch.pairs[base + g.pair] = wp.uint64(0)
                    cut = cut_of(scene, at[0], c, g, line)
                    x = crossing(scene, cut)
                    n = wp.atomic_add(scratch.count, 1, 1)
                    scratch.cuts[n] = cut
                    scratch.targets[n] = x.target
                    if x.target >= 0:
                        wp.atomic_add(maps.image, x.target, x.shift)


@wp.func
def mark_cut(scratch: Scratch, maps: Maps, i: int) -> None:
    """Mark a cut whose pixel is outside [0, 1], before any is bounded."""
    target = scratch.targets[i]
    if target >= 0:
        if maps.image[target] < 0.0 or maps.image[target] > 1.0:
            scratch.targets[i] = -2 - target


@wp.func
def bound_cut(scratch: Scratch, maps: Maps, i: int) -> None:
    """Bound the pixel of a marked cut to [0, 1]."""
    target = -2 - scratch.targets[i]
    if target >= 0:
        maps.image[target] = wp.clamp(maps.image[target], 0.0, 1.0)


@wp.func
def show(scene: Scene, scratch: Scratch, maps: Maps, at: wp.vec2i, row: int, column: int) -> None:
    """Write the maps of a pixel of the grid, and forget who won it."""
    grid = (at[1] * scene.height + row) * scene.width + column
    near = scratch.near[grid]
    far = scratch.far[grid]
    if (near | far) != wp.uint64(0):
        scratch.near[grid] = wp.uint64(0)
        scratch.far[grid] = wp.uint64(0)
        b = scene.border
        high = scene.height - 2 * b
        wide = scene.width - 2 * b
        if row >= b and row < high + b and column >= b and column < wide + b:
            show_pixel(maps, (at[0] * high + row - b) * wide + column - b, near, far)


@wp.kernel
def place_verts(scene: Scene, scratch: Scratch) -> None:
    """A thread for each vertex."""
    item, v = wp.tid()
    place_vert(scene, scratch, wp.vec2i(item, item), v)


@wp.kernel
def draw_faces(scene: Scene, scratch: Scratch, backs: int) -> None:
    """A thread for each triangle, which is queued where it has many rows."""
    item, f = wp.tid()
    if not draw_face(scene, scratch, wp.vec2i(item, item), f, backs, TALL):
        scratch.queue[wp.atomic_add(scratch.count, 0, 1)] = item * scene.n_faces + f


@wp.kernel
def draw_rows(scene: Scene, scratch: Scratch, backs: int) -> None:
    """Draw rows of the queued triangles, each thread every so many."""
    work = wp.tid()
    while work < scratch.count[0] * scene.height:
        queued = scratch.queue[work / scene.height]
        item = queued / scene.n_faces
        at = wp.vec2i(item, item)
        f = queued % scene.n_faces
        face = face_at(scene, at, f)
        t = triangle_of(scene, scratch, at, face)
        row = t.first + work % scene.height
        if row <= t.last:
            near = backs == FRONT or area_of(scene, scratch, at, face) < 0.0
            paint(scene, scratch, t, wp.vec3i(item, row, f), near)
        work += LANES


@wp.kernel
def enter_edges(scene: Scene, scratch: Scratch) -> None:
    """A thread for each edge."""
    item, e = wp.tid()
    enter_cuts(scene, scratch, wp.vec2i(item, item), e)


@wp.kernel
def show_pixels(scene: Scene, scratch: Scratch, maps: Maps) -> None:
    """A thread for each pixel of the grids."""
    item, row, column = wp.tid()
    show(scene, scratch, maps, wp.vec2i(item, item), row, column)


@wp.kernel
def keep_edges(scene: Scene, scratch: Scratch, maps: Maps) -> None:
    """A thread for each edge."""
    item, e = wp.tid()
    keep_cuts(scene, scratch, maps, wp.vec2i(item, item), e)


@wp.kernel
def mark_cuts(scratch: Scratch, maps: Maps) -> None:
    """A thread for each cut."""
    mark_cut(scratch, maps, wp.tid())


@wp.kernel
def bound_cuts(scratch: Scratch, maps: Maps) -> None:
    """A thread for each cut."""
    bound_cut(scratch, maps, wp.tid())


@wp.kernel
def pull_cuts(scene: Scene, pull: Pull) -> None:
    """Gradient of one cut."""
    i = wp.tid()
    if pull.targets[i] >= 0:
        pull_cut(scene, pull.cuts[i], pull.image[pull.targets[i]], pull.verts)


@wp.kernel
def pull_pixels(scene: Scene, maps: Maps, pull: Pull) -> None:
    """Gradient of the depths of one pixel."""
    pull_pixel(scene, maps, pull, wp.tid())
