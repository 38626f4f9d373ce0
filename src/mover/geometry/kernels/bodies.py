"""Warp kernels that lower a volume to the signed distance of one closed body.

Positions are in cells: the centres of the grid's cells have integer coordinates. Scratch arrays
are laid out by column, (x, z, y), with one place more than the body's box has along y.
"""

import warp as wp

from mover.geometry.kernels.packs import enter, unite

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SHELL = wp.constant(2.0)  # [cells], see `volume.SHELL`
REACH = wp.constant(2.001)  # [cells], of blocks that are marked; the shell and its rounding
BESIDE = wp.constant(wp.uint8(1))  # marks of blocks: the surface may be within the shell
WITHIN = wp.constant(wp.uint8(2))  # a place of the block is inside
SNAP = wp.constant(wp.float64(65536.0))  # vertices snap to this part of a cell, as in `volume`
BITS = wp.constant(wp.int64(16))
Pair = wp.types.vector(length=2, dtype=wp.int64)
SLACK = wp.constant(1.0001)  # of squared limits; rounding is a thousand times smaller


@wp.struct
class Tree:
    """The triangles of a body and the boxes around them in packs of eight; see `FaceTree`.

    `boxes` and `shapes` are laid out as in `packs`. `stack` is scratch for slots that are to be
    looked into, with room for `longest`.
    """

    shift: int
    base: int
    corners: wp.array(dtype=wp.int32)
    boxes: wp.array(dtype=wp.float32)
    shapes: wp.array(dtype=wp.float32)
    slabs: wp.array(dtype=wp.float32)
    stack: wp.array(dtype=wp.int32)
    longest: int


@wp.struct
class Work:
    """One body on its way into a volume; one of these for each worker.

    `other` is the volume of another worker: what is no lower than there need not be measured.
    It is read while it is written; any value that it has held is right, since it only falls.
    """

    origin: wp.vec3d
    cell: wp.float64
    low: wp.vec3i
    size: wp.vec3i
    world: wp.array(dtype=wp.vec3)
    place: wp.array(dtype=wp.vec3d)
    at: wp.array(dtype=wp.vec3)
    lines: wp.array(dtype=Pair)
    faces: wp.array(dtype=wp.vec3i)
    tree: Tree
    turn: wp.array(dtype=wp.float64)
    steps: wp.array(dtype=wp.int32)
    crossed: wp.array(dtype=wp.uint8)
    owner: wp.array(dtype=wp.int32)
    beside: int
    eight: int
    near: wp.array(dtype=wp.uint8)
    field: wp.array3d(dtype=wp.float32)
    other: wp.array3d(dtype=wp.float32)


@wp.kernel
def place(w: Work) -> None:
    """Vertices in cells, and where they are among the columns (x, z) of the box, in fixed point."""
    i = wp.tid()
    v = w.world[i]
    at = wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))
    p = (at - w.origin) / w.cell
    w.place[i] = p
    x = wp.int64(wp.rint(p[0] * SNAP)) - (wp.int64(w.low[0]) << BITS)
    z = wp.int64(wp.rint(p[2] * SNAP)) - (wp.int64(w.low[2]) << BITS)
    w.lines[i] = Pair(x, z)
    w.at[i] = wp.vec3(wp.float32(p[0]), wp.float32(p[1]), wp.float32(p[2]))


@wp.func
def block_of(w: Work, x: int, y: int, z: int) -> int:
    """Index of the block of two by two by two that holds a place of the box."""
    return ((x >> 1) * ((w.size[2] + 1) >> 1) + (z >> 1)) * ((w.size[1] + 1) >> 1) + (y >> 1)


@wp.func
def mark(w: Work, slot: int) -> None:
    """Mark the blocks within the shell of a box of the surface."""
    a = wp.vec3i()
    b = wp.vec3i()
    box = 48 * (slot / 8) + slot % 8
    for k in range(3):
        low = w.tree.boxes[box + 8 * k]
        high = w.tree.boxes[box + 8 * k + 24]
        a[k] = wp.max(int(wp.ceil(low - REACH)) - w.low[k], 0) >> 1
        b[k] = wp.min(int(wp.floor(high + REACH)) - w.low[k], w.size[k] - 1) >> 1
    for i in range(a[0], b[0] + 1):
        for k in range(a[2], b[2] + 1):
            first = block_of(w, i << 1, a[1] << 1, k << 1)
            for j in range(b[1] - a[1] + 1):
                w.near[first + j] = BESIDE


@wp.kernel
def leaves(w: Work) -> None:
    """The tree's leaves, the blocks near them, and the enclosed volume."""
    leaf = wp.tid()
    slot = w.tree.base + leaf
    volume = enter(w.tree.corners, w.at, leaf, slot, w.tree.shapes, w.tree.boxes, w.tree.slabs)
    wp.atomic_add(w.turn, 0, wp.float64(volume))
    mark(w, slot)


@wp.kernel
def inner(w: Work, pack: int, first: int) -> None:
    """Boxes of the nodes from slot `first` on, one level, from those from `pack` on, the next."""
    node = wp.tid()
    unite(w.tree.boxes, pack + node, first + node)


@wp.struct
class Flat:
    """A triangle seen along y, in fixed point, counter-clockwise."""

    x: wp.types.vector(length=3, dtype=wp.int64)
    z: wp.types.vector(length=3, dtype=wp.int64)
    y: wp.vec3d
    sign: int


@wp.func
def flat(w: Work, t: wp.vec3i) -> Flat:
    """See `Flat`; the sign is 0 where the triangle is seen edge-on."""
    r = Flat()
    u = w.lines[t[1]] - w.lines[t[0]]
    v = w.lines[t[2]] - w.lines[t[0]]
    area = u[0] * v[1] - u[1] * v[0]
    r.sign = wp.where(area < wp.int64(0), -1, wp.where(area > wp.int64(0), 1, 0))
    for k in range(3):
        corner = t[wp.where(r.sign < 0, (3 - k) % 3, k)]
        line = w.lines[corner]
        r.x[k] = line[0]
        r.z[k] = line[1]
        r.y[k] = w.place[corner][1]
    return r


@wp.func
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
def cross(w: Work) -> None:
    """Signed crossings of the columns with each triangle, one step where they pass it."""
    t = w.faces[wp.tid()]
    u = w.lines[t[0]]
    v = w.lines[t[1]]
    p = w.lines[t[2]]
    one = wp.int64(65535)
    xl = wp.max(int((wp.min(u[0], wp.min(v[0], p[0])) + one) >> BITS), 0)
    xh = wp.min(int(wp.max(u[0], wp.max(v[0], p[0])) >> BITS), w.size[0] - 1)
    zl = wp.max(int((wp.min(u[1], wp.min(v[1], p[1])) + one) >> BITS), 0)
    zh = wp.min(int(wp.max(u[1], wp.max(v[1], p[1])) >> BITS), w.size[2] - 1)
    if xl > xh or zl > zh:
        return
    r = flat(w, t)
    if r.sign == 0:
        return
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
                w.crossed[(x >> 1) * ((w.size[2] + 1) >> 1) + (z >> 1)] = wp.uint8(1)
                wp.atomic_add(w.steps, (x * w.size[2] + z) * (w.size[1] + 1) + y, r.sign)
