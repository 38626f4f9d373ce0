# pyright: basic, reportInvalidTypeForm=false
"""Warp functions of the distance from places to triangles, and of the tree over these.

A triangle counts as no nearer than the box around it. No rounding then makes a triangle nearer
than a box that holds it, and the least distance is the same bits whatever the tree, the order of
the search or what was known before it.
"""

from typing import no_type_check

import warp as wp

from .bodies import FAR, MARGIN, Tree

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

TINY = wp.constant(1.0e-30)


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
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    whole = wp.max(d3 * d6 - d5 * d4 + vb + vc, TINY)
    return wp.length_sq(ap - ab * (vb / whole) - ac * (vc / whole))


@wp.func
@no_type_check
def gap(a: float, b: float) -> float:
    """Of two numbers, of which not both are above zero, the one that is; else zero.

    Exact, and without a comparison: `wp.max` takes care of NaN, which is many times slower.
    """
    return 0.5 * ((a + wp.abs(a)) + (b + wp.abs(b)))


@wp.func
@no_type_check
def between(low: wp.vec3, high: wp.vec3, below: wp.vec3, above: wp.vec3) -> float:
    """Squared distance between two boxes."""
    x = gap(below[0] - high[0], low[0] - above[0])
    y = gap(below[1] - high[1], low[1] - above[1])
    z = gap(below[2] - high[2], low[2] - above[2])
    return x * x + y * y + z * z


@wp.func
@no_type_check
def to_box(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """Squared distance to a box."""
    return between(p, p, low, high)


@wp.func
@no_type_check
def to_corners(t: Tree, p: wp.vec3, face: int) -> float:
    """Squared distance to the triangle of a face."""
    k = 3 * face
    return to_triangle(p, t.corners[k], t.corners[k + 1], t.corners[k + 2])


@wp.func
@no_type_check
def to_face(t: Tree, p: wp.vec3, face: int) -> float:
    """Squared distance to one face; far away for none."""
    if face < 0:
        return FAR
    box = t.start[4] + face
    least = to_box(p, t.below[box], t.above[box])
    d = to_corners(t, p, face)
    return wp.where(d > least, d, least)


@wp.func
@no_type_check
def off(p: wp.vec3, plane: wp.vec4) -> float:
    """Distance to a plane."""
    return wp.abs(plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[3])


@wp.func
@no_type_check
def in_leaves(t: Tree, p: wp.vec3, first: int, end: int, best: float) -> tuple[float, int]:
    """Nearest face of listed leaves, if it is nearer than what is known: squared distance, face."""
    least = float(best)
    reach = wp.sqrt(least)
    face = int(-1)
    for k in range(first, end):
        leaf = t.leaves[k]
        at = t.start[3] + leaf
        box = to_box(p, t.below[at], t.above[at])
        if box < least and off(p, t.slab[leaf]) - t.thick[leaf] < reach:
            for f in range(t.first[leaf], t.first[leaf + 1]):
                at = t.start[4] + f
                box = to_box(p, t.below[at], t.above[at])
                if box < least and off(p, t.plane[f]) - MARGIN < reach:
                    d = to_corners(t, p, f)
                    d = wp.where(d > box, d, box)
                    if d < least:
                        least = d
                        reach = wp.sqrt(d)
                        face = f
    return least, face


@wp.func
@no_type_check
def under(t: Tree, low: wp.vec3, high: wp.vec3, reach: float, node: int, first: int) -> int:
    """Add the leaves under a node of the second level to a list, see `gather`."""
    end = int(first)
    n = t.branches
    wide = high - low
    middle = low + 0.5 * wide
    far = wp.sqrt(reach)
    for k in range(n * node, n * node + n):
        box = t.start[2] + k
        if between(low, high, t.below[box], t.above[box]) < reach:
            for leaf in range(n * k, n * k + n):
                s = t.slab[leaf]
                spread = wp.abs(s[0]) * wide[0] + wp.abs(s[1]) * wide[1] + wp.abs(s[2]) * wide[2]
                if off(middle, s) - t.thick[leaf] - 0.5 * spread < far:
                    box = t.start[3] + leaf
                    if between(low, high, t.below[box], t.above[box]) < reach:
                        t.leaves[end] = leaf
                        end += 1
    return end


@wp.func
@no_type_check
def gather(t: Tree, low: wp.vec3, high: wp.vec3, reach: float, first: int) -> int:
    """List the leaves nearer to a box than a squared distance; the list's end, -1 if too long."""
    end = int(first)
    n = t.branches
    for i in range(n):
        if between(low, high, t.below[i], t.above[i]) < reach:
            for j in range(n * i, n * i + n):
                box = t.start[1] + j
                if between(low, high, t.below[box], t.above[box]) < reach:
                    if end - first + n * n > t.longest:
                        return -1
                    end = under(t, low, high, reach, j, end)
    return end


@wp.func
@no_type_check
def in_tree(t: Tree, p: wp.vec3, first: int, best: float) -> tuple[float, int]:
    """Nearest face of all, if it is nearer than what is known: squared distance, face."""
    least = float(best)
    face = int(-1)
    n = t.branches
    for i in range(n):
        if to_box(p, t.below[i], t.above[i]) < least:
            for j in range(n * i, n * i + n):
                box = t.start[1] + j
                if to_box(p, t.below[box], t.above[box]) < least:
                    end = under(t, p, p, least, j, first)
                    d, one = in_leaves(t, p, first, end, least)
                    if one >= 0:
                        least = d
                        face = one
    return least, face
