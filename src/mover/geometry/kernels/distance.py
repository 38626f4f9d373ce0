# pyright: basic, reportInvalidTypeForm=false
"""Warp kernels of the distance from cells to triangles; see `bodies`."""

from typing import no_type_check

import warp as wp

from .bodies import FAR, SHELL, SLACK, Tree, Work, block_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TINY = wp.constant(1.0e-30)
STEP = wp.constant(1.0001)  # [cells], to the next place, and rounding
AHEAD = wp.constant(1.2)  # [cells], to search further than needed: the next places gain from it


@wp.func
@no_type_check
def along(v: wp.vec3, edge: wp.vec3, share: float, whole: float) -> float:
    """Squared distance to a point of an edge; `v` starts where the edge does."""
    return wp.length_sq(v - edge * (share / wp.max(whole, TINY)))


@wp.func
@no_type_check
def to_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Squared distance to a triangle (the regions of Ericson, Real-Time Collision Detection)."""
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.length_sq(ap)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.length_sq(bp)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.length_sq(cp)
    if d1 * d4 <= d3 * d2 and d1 >= 0.0 and d3 <= 0.0:
        return along(ap, ab, d1, d1 - d3)
    if d5 * d2 <= d1 * d6 and d2 >= 0.0 and d6 <= 0.0:
        return along(ap, ac, d2, d2 - d6)
    if d3 * d6 <= d5 * d4 and d4 >= d3 and d5 >= d6:
        return along(bp, c - b, d4 - d3, d4 - d3 + d5 - d6)
    n = wp.cross(ab, ac)
    d = wp.dot(ap, n)
    return d * d / wp.max(wp.length_sq(n), TINY)


@wp.func
@no_type_check
def to_face(t: Tree, p: wp.vec3, face: int) -> float:
    """Squared distance to one face; far away for none."""
    if face < 0:
        return FAR
    return to_triangle(p, t.corners[3 * face], t.corners[3 * face + 1], t.corners[3 * face + 2])


@wp.func
@no_type_check
def to_box(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """Squared distance to a box."""
    out = wp.max(wp.max(low - p, p - high), wp.vec3(0.0, 0.0, 0.0))
    return wp.length_sq(out)


@wp.func
@no_type_check
def look_in(t: Tree, p: wp.vec3, node: int, best: float, face: int) -> tuple[float, int]:
    """Look for a nearer face in one node above the leaves: squared distance and face."""
    start = t.branches * node
    for k in range(start, start + t.branches):
        leaf = t.start[3] + k
        if to_box(p, t.below[leaf], t.above[leaf]) <= best * SLACK:
            for f in range(t.first[k], t.first[k + 1]):
                box = t.start[4] + f
                if to_box(p, t.below[box], t.above[box]) <= best * SLACK:
                    a = t.corners[3 * f]
                    d = to_triangle(p, a, t.corners[3 * f + 1], t.corners[3 * f + 2])
                    if d < best:
                        best = d
                        face = f
    return best, face


@wp.func
@no_type_check
def search(t: Tree, p: wp.vec3, known: float, owner: int, enough: float) -> tuple[float, int]:
    """Least squared distance and its face, if less than what is known; ends where it is enough."""
    best = float(known)
    face = int(owner)
    n = t.branches
    for i in range(n):
        if to_box(p, t.below[i], t.above[i]) <= best * SLACK:
            for j in range(n * i, n * i + n):
                box = t.start[1] + j
                if to_box(p, t.below[box], t.above[box]) <= best * SLACK:
                    for k in range(n * j, n * j + n):
                        box = t.start[2] + k
                        if to_box(p, t.below[box], t.above[box]) <= best * SLACK:
                            best, face = look_in(t, p, k, best, face)
                            if best * SLACK <= enough:
                                return best, face
    return best, face


@wp.func
@no_type_check
def nearer_of(t: Tree, p: wp.vec3, one: int, other: int) -> tuple[float, int]:
    """The nearer of two faces: its squared distance and itself."""
    best = to_face(t, p, one)
    face = int(one)
    d = to_face(t, p, other)
    if d < best:
        best = d
        face = other
    return best, face


@wp.func
@no_type_check
def beside(w: Work, v: int) -> int:
    """A face that is near the place beside; -1 where none is known."""
    if v <= w.size[1]:
        return -1
    return w.owner[v - w.size[1] - 1]


@wp.func
@no_type_check
def deeper(w: Work, at: wp.vec3i, v: int, guess: int) -> int:
    """Lower the field at one place inside; gives a face that is near."""
    cell = wp.float32(w.cell)
    p = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    held = w.field[at[0], at[1], at[2]] / cell
    enough = wp.where(held < 0.0, held * held, -1.0)
    known, face = nearer_of(w.tree, p, guess, beside(w, v))
    if known * SLACK > enough:  # else the place is not as deep in this body as in another
        known, face = search(w.tree, p, known, face, enough)
        depth = -wp.sqrt(known) * cell
        w.field[at[0], at[1], at[2]] = wp.min(w.field[at[0], at[1], at[2]], depth)
    return face


@wp.func
@no_type_check
def nearer(w: Work, at: wp.vec3i, v: int, guess: int, least: float) -> tuple[int, float]:
    """Lower the field at one place outside; gives a face that is near and the least distance."""
    cell = wp.float32(w.cell)
    p = wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    held = w.field[at[0], at[1], at[2]] / cell
    limit = wp.min(SHELL, held) * SLACK
    if least >= limit:
        return guess, least
    reach = (limit + AHEAD) * (limit + AHEAD)
    known, face = nearer_of(w.tree, p, guess, beside(w, v))
    if known >= reach:
        known = reach
    known, face = search(w.tree, p, known, face, -1.0)
    distance = wp.sqrt(known)
    if known < reach and distance <= SHELL:
        w.field[at[0], at[1], at[2]] = wp.min(w.field[at[0], at[1], at[2]], distance * cell)
    return face, distance


@wp.kernel
@no_type_check
def columns(w: Work) -> None:
    """Lower the field along one column of the body's box."""
    column = wp.tid()
    x = column / w.size[2]
    z = column - x * w.size[2]
    side = wp.where(w.turn[0] < wp.float64(0.0), -1, 1)
    winding = wp.int32(0)
    guess = wp.int32(-1)
    least = wp.float32(0.0)
    for y in range(w.size[1]):
        v = column * (w.size[1] + 1) + y
        winding += w.steps[v] * side
        if w.beside > 0 and z > 0:
            least = wp.max(least, w.least[v - w.size[1] - 1])
        if w.beside > 0 and x > 0:
            least = wp.max(least, w.least[v - w.size[2] * (w.size[1] + 1)])
        least = wp.max(least - STEP, 0.0)
        at = w.low + wp.vec3i(x, y, z)
        if winding > 0:
            guess = deeper(w, at, v, guess)
            least = 0.0
        elif w.near[block_of(w, x, y, z)] == wp.uint8(0):
            least = wp.max(least, SHELL)
        elif w.field[at[0], at[1], at[2]] > 0.0:
            guess, least = nearer(w, at, v, guess, least)
        w.owner[v] = guess
        w.least[v] = least
