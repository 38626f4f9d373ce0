"""Warp kernel of the nearest points of scaled clouds."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FAN = wp.constant(16)  # points of a box
FAR = wp.constant(1.0e30)
SLACK = wp.constant(1.0001)  # of squared distances, so that rounding skips no box that counts


@wp.struct
class Cloud:
    """Points of each object in the order of their boxes, and the boxes."""

    points: wp.array2d(dtype=wp.vec3)
    index: wp.array2d(dtype=wp.int64)
    low: wp.array2d(dtype=wp.vec3)
    high: wp.array2d(dtype=wp.vec3)


@wp.struct
class Query:
    """A position in the axes of an object, and the object's size."""

    item: int
    place: wp.vec3
    scale: wp.vec3


@wp.func
def nearest_of(c: Cloud, q: Query, guess: int) -> int:
    """Where the nearest point is; the first of those equally near. Any guess gives the same."""
    place = wp.max(guess, 0)
    best = wp.length_sq(wp.cw_mul(c.points[q.item, place], q.scale) - q.place)
    for box in range(c.low.shape[1]):
        a = wp.cw_mul(c.low[q.item, box], q.scale) - q.place
        b = q.place - wp.cw_mul(c.high[q.item, box], q.scale)
        if wp.length_sq(wp.max(wp.max(a, b), wp.vec3(0.0, 0.0, 0.0))) <= best * SLACK:
            for k in range(box * FAN, wp.min(box * FAN + FAN, c.points.shape[1])):
                d = wp.length_sq(wp.cw_mul(c.points[q.item, k], q.scale) - q.place)
                if d < best or (d == best and c.index[q.item, k] < c.index[q.item, place]):
                    best = d
                    place = k
    return place


@wp.kernel
def nearest(
    c: Cloud,
    query: wp.array2d(dtype=wp.vec3),
    scale: wp.array(dtype=wp.vec3),
    found: wp.array2d(dtype=wp.int64),
    first_row: int,
) -> None:
    """Index of the nearest scaled point of each query; the first of those equally near."""
    tid, column = wp.tid()
    row = first_row + tid
    q = Query()
    q.item = row % c.points.shape[0]
    q.place = query[row, column]
    q.scale = scale[row]
    found[row, column] = c.index[q.item, nearest_of(c, q, -1)]
