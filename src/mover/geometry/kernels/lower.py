# pyright: basic, reportInvalidTypeForm=false
"""Warp kernels that lower a volume where a body is deeper or nearer; see `bodies`.

Places are measured in blocks of two along each axis. Which of a block's places can gain is known
from a face that is near (that of a block beside); for these the leaves of the tree that can hold
the nearest face are listed once, and only those are searched.
"""

from typing import no_type_check

import warp as wp

from .bodies import SHELL, SLACK, Work, block_of
from .distance import gather, in_leaves, in_tree, to_face

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

Eight = wp.types.vector(length=8, dtype=wp.float32)


@wp.func
@no_type_check
def corner(k: int) -> wp.vec3i:
    """Place in a block."""
    return wp.vec3i(k >> 2, (k >> 1) & 1, k & 1)


@wp.func
@no_type_check
def place_of(w: Work, at: wp.vec3i) -> int:
    """Index of a place of the box in `steps`."""
    return (at[0] * w.size[2] + at[2]) * (w.size[1] + 1) + at[1]


@wp.func
@no_type_check
def inside_of(w: Work, at: wp.vec3i) -> bool:
    """Whether a place is in the box and in the body; to be called after `add_up`."""
    if at[0] >= w.size[0] or at[1] >= w.size[1] or at[2] >= w.size[2]:
        return False
    return w.steps[place_of(w, at)] > 0


@wp.func
@no_type_check
def add_up(w: Work, x: int, z: int) -> None:
    """Turn the steps along a column into winding numbers, positive inside."""
    if x >= w.size[0] or z >= w.size[2]:
        return
    side = wp.where(w.turn[0] < wp.float64(0.0), -1, 1)
    winding = wp.int32(0)
    first = place_of(w, wp.vec3i(x, 0, z))
    for v in range(first, first + w.size[1]):
        winding += w.steps[v] * side
        w.steps[v] = winding


@wp.func
@no_type_check
def open_to(w: Work, at: wp.vec3i, near: bool, known: float) -> float:
    """Squared distance below which a face lowers the field at a place; negative for none.

    Args:
        w: The body and the volume.
        at: The place in the body's box.
        near: Whether the surface may be within the shell.
        known: Squared distance to a face that is near [cells²].
    """
    if at[0] >= w.size[0] or at[1] >= w.size[1] or at[2] >= w.size[2]:
        return -1.0
    g = w.low + at
    cell = wp.float32(w.cell)
    held = wp.min(w.field[g[0], g[1], g[2]], w.other[g[0], g[1], g[2]])
    if w.steps[place_of(w, at)] > 0:
        return wp.where(-wp.sqrt(known) * cell >= held, -1.0, known)
    if held <= 0.0 or not near:
        return -1.0
    limit = wp.min(SHELL, held / cell)
    return wp.min(known, limit * limit * SLACK)


@wp.func
@no_type_check
def put(w: Work, at: wp.vec3i, known: float) -> None:
    """Lower the field at one place."""
    g = w.low + at
    distance = wp.sqrt(known)
    signed = distance * wp.float32(w.cell)
    if w.steps[place_of(w, at)] > 0:
        w.field[g[0], g[1], g[2]] = wp.min(w.field[g[0], g[1], g[2]], -signed)
    elif distance <= SHELL:
        w.field[g[0], g[1], g[2]] = wp.min(w.field[g[0], g[1], g[2]], signed)


@wp.func
@no_type_check
def center(at: wp.vec3i) -> wp.vec3:
    """A place in single precision."""
    return wp.vec3(float(at[0]), float(at[1]), float(at[2]))


@wp.func
@no_type_check
def nearest_of(w: Work, p: wp.vec3, guess: int, block: int) -> int:
    """Of the faces near the block before and those beside, the one that is nearest to a point."""
    if w.beside == 0:
        return guess
    face = int(guess)
    best = to_face(w.tree, p, guess)
    rows = (w.size[1] + 1) >> 1
    for k in range(2):
        back = wp.where(k == 0, rows, rows * ((w.size[2] + 1) >> 1))
        if block >= back:
            one = w.owner[block - back]
            if one != face:
                d = to_face(w.tree, p, one)
                if d < best:
                    best = d
                    face = one
    return face


@wp.func
@no_type_check
def measure(w: Work, at: wp.vec3i, near: bool, guess: int, first: int) -> int:
    """Lower the field in one block; gives a face that is near."""
    low = center(w.low + at)
    known = Eight()
    reach = float(-1.0)
    for k in range(w.eight):
        here = at + corner(k)
        known[k] = open_to(w, here, near, to_face(w.tree, center(w.low + here), guess))
        reach = wp.max(reach, known[k])
    if reach < 0.0:
        return guess
    face = int(guess)
    end = gather(w.tree, low, low + wp.vec3(1.0, 1.0, 1.0), reach, first)
    for k in range(w.eight):
        if known[k] >= 0.0:
            here = at + corner(k)
            p = center(w.low + here)
            best = wp.min(known[k], to_face(w.tree, p, face))
            found = int(-1)
            if end < 0:
                best, found = in_tree(w.tree, p, first, best)
            else:
                best, found = in_leaves(w.tree, p, first, end, best)
            put(w, here, best)
            if found >= 0:
                face = found
    return face


@wp.kernel
@no_type_check
def blocks(w: Work) -> None:
    """Lower the field along two by two columns of the body's box."""
    column = wp.tid()
    wide = (w.size[2] + 1) >> 1
    x = 2 * (column / wide)
    z = 2 * (column - (column / wide) * wide)
    for k in range(4):
        add_up(w, x + (k >> 1), z + (k & 1))
    rows = (w.size[1] + 1) >> 1
    first = wp.where(w.beside > 0, 0, column * w.tree.longest)
    guess = int(-1)
    for row in range(rows):
        at = wp.vec3i(x, 2 * row, z)
        near = w.near[block_of(w, x, 2 * row, z)] != wp.uint8(0)
        some = bool(near)
        for k in range(w.eight):
            some = some or inside_of(w, at + corner(k))
        block = column * rows + row
        if some:
            guess = nearest_of(w, center(w.low + at) + wp.vec3(0.5, 0.5, 0.5), guess, block)
            guess = measure(w, at, near, guess, first)
        w.owner[block] = guess
