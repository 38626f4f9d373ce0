"""Warp kernels that lower a volume where a body is deeper or nearer; see `bodies`.

Places are measured in blocks of two along each axis. Which of a block's places can gain is known
from a leaf that is near (that of a block beside); for these the tree is searched once, with what
the eight places know together. Nothing is left out that the rounding of distances might hide: the
least distance is the same bits whatever the tree, the order of the search or what was known.
"""

import warp as wp

from mover.geometry.kernels.bodies import BESIDE, SHELL, SLACK, WITHIN, Work
from mover.geometry.kernels.packs import Eight, expand, look, reached, to_leaf

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FAR = wp.constant(1.0e30)
LOOSE = wp.constant(1.002)  # times a squared distance, and MORES: no less than the square of
MORES = wp.constant(Eight(*[0.0021] * 8))  # 0.002 cells more; rounding is ten times smaller


@wp.func
def corner(k: int) -> wp.vec3i:
    """Place in a block."""
    return wp.vec3i(k >> 2, (k >> 1) & 1, k & 1)


@wp.func
def place_of(w: Work, at: wp.vec3i) -> int:
    """Index of a place of the box in `steps`."""
    return (at[0] * w.size[2] + at[2]) * (w.size[1] + 1) + at[1]


@wp.func
def add_up(w: Work, x: int, z: int, block: int) -> None:
    """Turn the steps along a column into winding numbers, positive inside, and mark its blocks."""
    if x >= w.size[0] or z >= w.size[2]:
        return
    side = wp.where(w.turn[0] < wp.float64(0.0), -1, 1)
    winding = wp.int32(0)
    first = place_of(w, wp.vec3i(x, 0, z))
    for y in range(w.size[1]):
        winding += w.steps[first + y] * side
        w.steps[first + y] = winding
        if winding > 0:
            w.near[block + (y >> 1)] = w.near[block + (y >> 1)] | WITHIN


@wp.func
def open_to(w: Work, at: wp.vec3i, near: bool, guess: int) -> float:
    """Squared distance below which a face lowers the field at a place; negative for none.

    Args:
        w: The body and the volume.
        at: The place in the body's box.
        near: Whether the surface may be within the shell.
        guess: A leaf that is near; negative for none.
    """
    if at[0] >= w.size[0] or at[1] >= w.size[1] or at[2] >= w.size[2]:
        return -1.0
    g = w.low + at
    held = w.field[g[0], g[1], g[2]]
    than = w.other[g[0], g[1], g[2]]
    held = wp.where(than < held, than, held) / wp.float32(w.cell)
    square = held * held
    inside = w.steps[place_of(w, at)] > 0
    if not inside and (held <= 0.0 or not near):
        return -1.0
    known = float(FAR)
    if guess >= 0:
        known = to_leaf(w.tree.shapes, guess, center(g))
    if inside:
        return wp.where(held < 0.0 and known * SLACK < square, -1.0, known)
    limit = wp.where(held < SHELL, square, SHELL * SHELL) * SLACK
    return wp.where(known < limit, known, limit)


@wp.func
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
def center(at: wp.vec3i) -> wp.vec3:
    """A place in single precision."""
    return wp.vec3(float(at[0]), float(at[1]), float(at[2]))


@wp.func
def nearest_of(w: Work, p: wp.vec3, guess: int, block: int) -> int:
    """Of the leaves near the block before and those beside, the one that is nearest to a point."""
    if w.beside == 0:
        return guess
    leaf = int(guess)
    best = float(FAR)
    if guess >= 0:
        best = to_leaf(w.tree.shapes, guess, p)
    rows = (w.size[1] + 1) >> 1
    for k in range(2):
        back = wp.where(k == 0, rows, rows * ((w.size[2] + 1) >> 1))
        if block >= back:
            one = w.owner[block - back]
            if one != leaf and one >= 0:
                d = to_leaf(w.tree.shapes, one, p)
                if d < best:
                    best = d
                    leaf = one
    return leaf


@wp.func
def farthest(known: Eight) -> float:
    """The largest of eight numbers."""
    most = known[0]
    for k in range(1, 8):
        most = wp.where(known[k] > most, known[k], most)
    return most


@wp.func
def search(w: Work, low: wp.vec3, best: Eight, guess: int, first: int) -> tuple[Eight, int]:
    """Least squared distances at the places of a block, and a leaf that is near its last place.

    Args:
        w: The body.
        low: First place of the block.
        best: What is known of the squared distances; negative where nothing is searched.
        guess: A leaf that has been looked at.
        first: Where the stack begins.
    """
    high = low + wp.vec3(1.0, 1.0, 1.0)
    known = best
    loose = known * LOOSE + MORES
    leaf = int(guess)
    most = farthest(loose)
    end = expand(w.tree.boxes, 0, low, high, most, w.tree.stack, first)
    while end > first:
        end -= 1
        slot = w.tree.stack[end]
        at = slot - w.tree.base
        if at < 0:
            pack = slot + w.tree.shift
            end = expand(w.tree.boxes, pack, low, high, most, w.tree.stack, end)
        elif at != guess:
            hit = reached(w.tree.boxes, w.tree.slabs, slot, at, low, loose)
            if hit != 0:
                last = known[7]
                known = look(w.tree.shapes, at, low, hit, known)
                loose = known * LOOSE + MORES
                most = farthest(loose)
                leaf = wp.where(known[7] < last, at, leaf)
    return known, leaf


@wp.func
def measure(w: Work, at: wp.vec3i, near: bool, guess: int, first: int) -> int:
    """Lower the field in one block; gives a leaf that is near."""
    known = Eight()
    for k in range(w.eight):
        known[k] = open_to(w, at + corner(k), near, guess)
    if farthest(known) < 0.0:
        return guess
    known, leaf = search(w, center(w.low + at), known, guess, first)
    for k in range(w.eight):
        if known[k] >= 0.0:
            put(w, at + corner(k), known[k])
    return leaf


@wp.kernel
def blocks(w: Work) -> None:
    """Lower the field along two by two columns of the body's box."""
    column = wp.tid()
    wide = (w.size[2] + 1) >> 1
    x = 2 * (column / wide)
    z = 2 * (column - (column / wide) * wide)
    rows = (w.size[1] + 1) >> 1
    if w.crossed[column] != wp.uint8(0):
        for k in range(4):
            add_up(w, x + (k >> 1), z + (k & 1), column * rows)
    first = wp.where(w.beside > 0, 0, column * w.tree.longest)
    guess = int(-1)
    for row in range(rows):
        at = wp.vec3i(x, 2 * row, z)
        block = column * rows + row
        marked = w.near[block]
        if marked != wp.uint8(0):
            near = (marked & BESIDE) != wp.uint8(0)
            guess = nearest_of(w, center(w.low + at) + wp.vec3(0.5, 0.5, 0.5), guess, block)
            guess = measure(w, at, near, guess, first)
        w.owner[block] = guess
