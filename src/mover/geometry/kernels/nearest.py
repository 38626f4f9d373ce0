"""Warp kernel of the nearest points of scaled clouds."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

FAN = wp.constant(8)  # points of a leaf, leaves of a group
FAR = wp.constant(1.0e30)
SLACK = wp.constant(1.0001)  # of squared distances, so that rounding skips no box that counts


@wp.struct
class Cloud:
    """Points of each object in the order of their boxes, and the boxes of leaves and groups."""

    points: wp.array2d(dtype=wp.vec3)
    index: wp.array2d(dtype=wp.int64)
    leaf_low: wp.array2d(dtype=wp.vec3)
    leaf_high: wp.array2d(dtype=wp.vec3)
    group_low: wp.array2d(dtype=wp.vec3)
    group_high: wp.array2d(dtype=wp.vec3)


@wp.struct
class Query:
    """A place in the axes of an object, and the object's size."""

    item: int
    place: wp.vec3
    scale: wp.vec3


@wp.func
def to_box(q: Query, low: wp.vec3, high: wp.vec3) -> float:
    """Squared distance to a scaled box."""
    a = wp.cw_mul(low, q.scale) - q.place
    b = q.place - wp.cw_mul(high, q.scale)
    out = wp.max(wp.max(a, b), wp.vec3(0.0, 0.0, 0.0))
    return wp.dot(out, out)


@wp.func
def in_leaf(c: Cloud, q: Query, leaf: int, best: float, place: int) -> tuple[float, int]:
    """The nearest point of a leaf, if nearer than the best: squared distance and place."""
    for k in range(leaf * FAN, wp.min(leaf * FAN + FAN, c.points.shape[1])):
        d = wp.length_sq(wp.cw_mul(c.points[q.item, k], q.scale) - q.place)
        if d < best or (d == best and c.index[q.item, k] < c.index[q.item, place]):
            best = d
            place = k
    return best, place


@wp.func
def in_group(c: Cloud, q: Query, group: int, best: float, place: int) -> tuple[float, int]:
    """The same for a group of leaves."""
    for leaf in range(group * FAN, wp.min(group * FAN + FAN, c.leaf_low.shape[1])):
        if to_box(q, c.leaf_low[q.item, leaf], c.leaf_high[q.item, leaf]) <= best * SLACK:
            best, place = in_leaf(c, q, leaf, best, place)
    return best, place


@wp.func
def nearest_group(c: Cloud, q: Query) -> int:
    """The group whose box is nearest; the first of those equally near."""
    first = int(0)
    least = float(FAR)
    for group in range(c.group_low.shape[1]):
        d = to_box(q, c.group_low[q.item, group], c.group_high[q.item, group])
        if d < least:
            least = d
            first = group
    return first


@wp.func
def nearest_of(c: Cloud, q: Query, guess: int) -> int:
    """Where the nearest point is; the first of those equally near. Any guess gives the same."""
    best = FAR
    place = int(0)
    first = int(-1)
    if guess >= 0:
        place = guess
        best = wp.length_sq(wp.cw_mul(c.points[q.item, guess], q.scale) - q.place)
    else:
        first = nearest_group(c, q)
        best, place = in_group(c, q, first, FAR, 0)
    for group in range(c.group_low.shape[1]):
        d = to_box(q, c.group_low[q.item, group], c.group_high[q.item, group])
        if group != first and d <= best * SLACK:
            best, place = in_group(c, q, group, best, place)
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
