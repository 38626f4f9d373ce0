# pyright: basic, reportInvalidTypeForm=false, reportGeneralTypeIssues=false
"""Warp kernels that lower a volume to the signed distance of one closed body.

Positions are in cells: the centres of the grid's cells have integer coordinates. Scratch arrays
are laid out by column, (x, z, y), with one place more than the body's box has along y.
"""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SHELL = wp.constant(2.0)  # [cells], see `volume.SHELL`
BLOCK = wp.constant(2)  # bits: blocks of 4 cells are marked as near the surface
SLACK = wp.constant(1.0001)  # of squared limits; rounding is a thousand times smaller
FAR = wp.constant(1.0e30)
MARGIN = wp.constant(0.002)  # [cells], of distances to planes; rounding is a hundred times smaller


@wp.struct
@no_type_check
class Tree:
    """The triangles of a body and the boxes around them, level by level, then of each triangle.

    `plane` holds each triangle, `slab` and `thick` each leaf (its middle plane and half its
    thickness). `leaves` is scratch for lists that have room for `longest`.
    """

    branches: int
    start: wp.types.vector(length=5, dtype=wp.int32)
    first: wp.array(dtype=wp.int32)
    corners: wp.array(dtype=wp.vec3)
    below: wp.array(dtype=wp.vec3)
    above: wp.array(dtype=wp.vec3)
    plane: wp.array(dtype=wp.vec4)
    slab: wp.array(dtype=wp.vec4)
    thick: wp.array(dtype=wp.float32)
    leaves: wp.array(dtype=wp.int32)
    longest: int


@wp.struct
@no_type_check
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
    faces: wp.array(dtype=wp.vec3i)
    tree: Tree
    turn: wp.array(dtype=wp.float64)
    steps: wp.array(dtype=wp.int32)
    owner: wp.array(dtype=wp.int32)
    beside: int
    eight: int
    near: wp.array(dtype=wp.uint8)
    field: wp.array3d(dtype=wp.float32)
    other: wp.array3d(dtype=wp.float32)


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


@wp.func
@no_type_check
def direction(n: wp.vec3) -> wp.vec3:
    """Unit vector along another; zero where there is none."""
    size = wp.length(n)
    if size < 1.0e-12:
        return wp.vec3(0.0, 0.0, 0.0)
    return n / size


@wp.func
@no_type_check
def flatten(t: Tree, leaf: int, normal: wp.vec3) -> None:
    """The slab around the triangles of a leaf."""
    n = direction(normal)
    low = float(FAR)
    high = float(-FAR)
    for k in range(3 * t.first[leaf], 3 * t.first[leaf + 1]):
        h = wp.dot(n, t.corners[k])
        low = wp.min(low, h)
        high = wp.max(high, h)
    t.slab[leaf] = wp.vec4(n[0], n[1], n[2], 0.5 * (low + high))
    t.thick[leaf] = 0.5 * (high - low) + MARGIN


@wp.func
@no_type_check
def enter(w: Work, f: int, t: wp.vec3i) -> wp.vec3:
    """Corners, box and plane of a triangle; gives its normal, as long as twice its area.

    The corners are in the order of their indices: a mirrored body gives the same bits.
    """
    i = wp.min(t)
    k = wp.max(t)
    a = single(w.place[i])
    b = single(w.place[t[0] + t[1] + t[2] - i - k])
    c = single(w.place[k])
    w.tree.corners[3 * f] = a
    w.tree.corners[3 * f + 1] = b
    w.tree.corners[3 * f + 2] = c
    w.tree.below[w.tree.start[4] + f] = wp.min(a, wp.min(b, c))
    w.tree.above[w.tree.start[4] + f] = wp.max(a, wp.max(b, c))
    across = wp.cross(b - a, c - a)
    n = direction(across)
    w.tree.plane[f] = wp.vec4(n[0], n[1], n[2], wp.dot(n, a))
    even = (i == t[0] and k == t[2]) or (i == t[1] and k == t[0]) or (i == t[2] and k == t[1])
    return wp.where(even, across, -across)


@wp.kernel
@no_type_check
def leaves(w: Work) -> None:
    """Corners and boxes of the tree's leaves, the blocks near them, and the enclosed volume."""
    leaf = wp.tid()
    base = w.place[w.faces[0][0]]
    low = wp.vec3(FAR, FAR, FAR)
    high = -low
    normal = wp.vec3(0.0, 0.0, 0.0)
    total = wp.float64(0.0)
    for f in range(w.tree.first[leaf], w.tree.first[leaf + 1]):
        t = w.faces[f]
        total += wp.dot(wp.cross(w.place[t[0]] - base, w.place[t[1]] - base), w.place[t[2]] - base)
        normal += enter(w, f, t)
        low = wp.min(low, w.tree.below[w.tree.start[4] + f])
        high = wp.max(high, w.tree.above[w.tree.start[4] + f])
    mark(w, low, high)
    flatten(w.tree, leaf, normal)
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
