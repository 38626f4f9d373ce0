# pyright: basic, reportInvalidTypeForm=false, reportGeneralTypeIssues=false
"""Warp kernels that lower a volume to the signed distance of one closed body.

Positions are in cells: the centres of the grid's cells have integer coordinates. Scratch arrays
are laid out by column, (x, z, y), with one place more than the body's box has along y.

A box of triangles is skipped only if it is clearly further away than the best triangle so far
(`SLACK`). So the least distance is the same bits whatever the tree, the order of the search or
what was known before it.
"""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SNAP = wp.constant(wp.float64(65536.0))  # vertices snap to this part of a cell, as in `voxels`
BITS = wp.constant(wp.int64(16))
SHELL = wp.constant(2.0)  # [cells], see `volume.SHELL`
BLOCK = wp.constant(2)  # bits: blocks of 4 cells are marked as near the surface
SLACK = wp.constant(1.0001)  # of squared distances; rounding is a thousand times smaller
FAR = wp.constant(1.0e30)


@wp.struct
@no_type_check
class Tree:
    """The triangles of a body and the boxes around them, level by level, then of each triangle.

    Functions get a copy of their arguments, so what is searched often is kept small.
    """

    branches: int
    start: wp.types.vector(length=5, dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec3)
    below: wp.array(dtype=wp.vec3)
    above: wp.array(dtype=wp.vec3)


@wp.struct
@no_type_check
class Work:
    """One body on its way into a volume; one of these for each worker."""

    origin: wp.vec3d
    cell: wp.float64
    low: wp.vec3i
    size: wp.vec3i
    world: wp.array(dtype=wp.vec3)
    place: wp.array(dtype=wp.vec3d)
    faces: wp.array(dtype=wp.vec3i)
    tree: Tree
    turn: wp.array(dtype=wp.float64)
    steps: wp.array(dtype=wp.int32)
    owner: wp.array(dtype=wp.int32)
    least: wp.array(dtype=wp.float32)
    beside: int
    near: wp.array(dtype=wp.uint8)
    field: wp.array3d(dtype=wp.float32)


@wp.kernel
@no_type_check
def place(w: Work) -> None:
    """Vertices in cells."""
    i = wp.tid()
    v = w.world[i]
    at = wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))
    w.place[i] = (at - w.origin) / w.cell


@wp.func
@no_type_check
def single(v: wp.vec3d) -> wp.vec3:
    """A position in single precision."""
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
@no_type_check
def block_of(w: Work, x: int, y: int, z: int) -> int:
    """Index of the block that holds a place of the box."""
    sy = (w.size[1] >> BLOCK) + 1
    sz = (w.size[2] >> BLOCK) + 1
    return ((x >> BLOCK) * sy + (y >> BLOCK)) * sz + (z >> BLOCK)


@wp.func
@no_type_check
def mark(w: Work, low: wp.vec3, high: wp.vec3) -> None:
    """Mark the blocks within the shell of a box of the surface."""
    a = wp.vec3i()
    b = wp.vec3i()
    for k in range(3):
        a[k] = wp.max(int(wp.floor(low[k] - SHELL)) - w.low[k], 0) >> BLOCK
        b[k] = wp.min(int(wp.ceil(high[k] + SHELL)) - w.low[k], w.size[k] - 1) >> BLOCK
    for i in range(a[0], b[0] + 1):
        for j in range(a[1], b[1] + 1):
            for k in range(a[2], b[2] + 1):
                w.near[block_of(w, i << BLOCK, j << BLOCK, k << BLOCK)] = wp.uint8(1)


@wp.kernel
@no_type_check
def leaves(w: Work) -> None:
    """Corners and boxes of the tree's leaves, the blocks near them, and the enclosed volume."""
    leaf = wp.tid()
    base = w.place[w.faces[0][0]]
    low = wp.vec3(FAR, FAR, FAR)
    high = -low
    total = wp.float64(0.0)
    for f in range(w.tree.first[leaf], w.tree.first[leaf + 1]):
        t = w.faces[f]
        total += wp.dot(wp.cross(w.place[t[0]] - base, w.place[t[1]] - base), w.place[t[2]] - base)
        i = wp.min(t)  # in the order of their indices, so that a mirrored body gives the same bits
        k = wp.max(t)
        a = single(w.place[i])
        b = single(w.place[t[0] + t[1] + t[2] - i - k])
        c = single(w.place[k])
        w.tree.corners[3 * f] = a
        w.tree.corners[3 * f + 1] = b
        w.tree.corners[3 * f + 2] = c
        least = wp.min(a, wp.min(b, c))
        most = wp.max(a, wp.max(b, c))
        w.tree.below[w.tree.start[4] + f] = least
        w.tree.above[w.tree.start[4] + f] = most
        low = wp.min(low, least)
        high = wp.max(high, most)
    mark(w, low, high)
    w.tree.below[w.tree.start[3] + leaf] = low
    w.tree.above[w.tree.start[3] + leaf] = high
    wp.atomic_add(w.turn, 0, total)


@wp.kernel
@no_type_check
def inner(w: Work, level: int) -> None:
    """Boxes of the tree's nodes on one level, from those on the next."""
    node = wp.tid()
    low = wp.vec3(FAR, FAR, FAR)
    high = -low
    first = w.tree.start[level + 1] + node * w.tree.branches
    for k in range(first, first + w.tree.branches):
        low = wp.min(low, w.tree.below[k])
        high = wp.max(high, w.tree.above[k])
    w.tree.below[w.tree.start[level] + node] = low
    w.tree.above[w.tree.start[level] + node] = high


@wp.struct
@no_type_check
class Flat:
    """A triangle seen along y, in fixed point, counter-clockwise."""

    x: wp.types.vector(length=3, dtype=wp.int64)
    z: wp.types.vector(length=3, dtype=wp.int64)
    y: wp.vec3d
    sign: int


@wp.func
@no_type_check
def flat(w: Work, t: wp.vec3i) -> Flat:
    """See `Flat`; the sign is 0 where the triangle is seen edge-on."""
    r = Flat()
    for k in range(3):
        v = w.place[t[k]]
        r.x[k] = wp.int64(wp.rint(v[0] * SNAP)) - (wp.int64(w.low[0]) << BITS)
        r.z[k] = wp.int64(wp.rint(v[2] * SNAP)) - (wp.int64(w.low[2]) << BITS)
        r.y[k] = v[1]
    area = (r.x[1] - r.x[0]) * (r.z[2] - r.z[0]) - (r.z[1] - r.z[0]) * (r.x[2] - r.x[0])
    r.sign = 1
    if area == wp.int64(0):
        r.sign = 0
    if area < wp.int64(0):
        r.sign = -1
        x = r.x[1]
        z = r.z[1]
        y = r.y[1]
        r.x[1] = r.x[2]
        r.z[1] = r.z[2]
        r.y[1] = r.y[2]
        r.x[2] = x
        r.z[2] = z
        r.y[2] = y
    return r


@wp.func
@no_type_check
def weight(r: Flat, k: int, px: wp.int64, pz: wp.int64) -> wp.int64:
    """Twice the area of a column and the edge opposite of a corner; -1 if it is outside."""
    i = (k + 1) % 3
    j = (k + 2) % 3
    ex = r.x[j] - r.x[i]
    ez = r.z[j] - r.z[i]
    area = ex * (pz - r.z[i]) - ez * (px - r.x[i])
    owns = ez < wp.int64(0) or (ez == wp.int64(0) and ex > wp.int64(0))
    if area == wp.int64(0) and not owns:
        area = wp.int64(-1)
    return area


@wp.kernel
@no_type_check
def cross(w: Work) -> None:
    """Signed crossings of the columns with each triangle, one step where they pass it."""
    r = flat(w, w.faces[wp.tid()])
    if r.sign == 0:
        return
    one = wp.int64(65535)
    xl = wp.max(int((wp.min(r.x) + one) >> BITS), 0)
    xh = wp.min(int(wp.max(r.x) >> BITS), w.size[0] - 1)
    zl = wp.max(int((wp.min(r.z) + one) >> BITS), 0)
    zh = wp.min(int(wp.max(r.z) >> BITS), w.size[2] - 1)
    for x in range(xl, xh + 1):
        for z in range(zl, zh + 1):
            px = wp.int64(x) << BITS
            pz = wp.int64(z) << BITS
            a = weight(r, 0, px, pz)
            b = weight(r, 1, px, pz)
            c = weight(r, 2, px, pz)
            if wp.min(a, wp.min(b, c)) >= wp.int64(0):
                share = wp.vec3d(wp.float64(a), wp.float64(b), wp.float64(c))
                height = wp.dot(share, r.y) / wp.float64(a + b + c)
                y = int(wp.ceil(wp.clamp(height, wp.float64(-1.0e6), wp.float64(1.0e6))))
                y = wp.clamp(y - w.low[1], 0, w.size[1])
                wp.atomic_add(w.steps, (x * w.size[2] + z) * (w.size[1] + 1) + y, r.sign)
