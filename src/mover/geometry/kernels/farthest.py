"""Warp kernel that thins out points: each next one is the farthest from those before."""

import warp as wp

from mover.geometry.kernels.nearest import SLACK

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BLOCK = wp.constant(32)  # neighbours that share a box


@wp.struct
class Crowd:
    """Points in an order in which neighbours are together, and what is known of each block."""

    points: wp.array(dtype=wp.vec3)
    index: wp.array(dtype=wp.int64)
    """Where each was in the list that was given."""
    nearest: wp.array(dtype=float)
    """Squared distance to the chosen ones; inf at first."""
    low: wp.array(dtype=wp.vec3)
    high: wp.array(dtype=wp.vec3)
    most: wp.array(dtype=float)
    """The largest `nearest` of a block; inf at first."""
    place: wp.array(dtype=int)
    """Where that is."""


@wp.func
def is_better(c: Crowd, d: float, place: int, most: float, best: int) -> bool:
    """Farther, or as far and earlier in the list that was given."""
    return d > most or (d == most and c.index[place] < c.index[best])


@wp.func
def visit(c: Crowd, block: int, last: wp.vec3) -> None:
    """Bring a block up to date."""
    out = wp.max(wp.max(c.low[block] - last, last - c.high[block]), wp.vec3(0.0, 0.0, 0.0))
    if wp.length_sq(out) > c.most[block] * SLACK:
        return
    most = float(-1.0)
    best = int(0)
    for k in range(block * BLOCK, wp.min(block * BLOCK + BLOCK, c.points.shape[0])):
        d = wp.min(c.nearest[k], wp.length_sq(c.points[k] - last))
        c.nearest[k] = d
        if is_better(c, d, k, most, best):
            most = d
            best = k
    c.most[block] = most
    c.place[block] = best


@wp.kernel
def farthest(c: Crowd, first: int, chosen: wp.array(dtype=wp.int64)) -> None:
    """Indices of the points in the order of their choice, in one thread."""
    at = first
    for row in range(chosen.shape[0]):
        chosen[row] = c.index[at]
        last = c.points[at]
        most = float(-1.0)
        for block in range(c.most.shape[0]):
            visit(c, block, last)
            if is_better(c, c.most[block], c.place[block], most, at):
                most = c.most[block]
                at = c.place[block]
