# pyright: basic, reportInvalidTypeForm=false
"""Warp kernels of the distances between points of a moving object and points of the world.

Each thread has one object: it adds up distances and their change with the place, the yaw and the
logarithms of the scale. Points that follow one another lie close together, so that the partner of
the last one is a good first guess for the next; any guess leads to the same partner.
"""

from typing import no_type_check

import warp as wp

from .nearest import Cloud, Query, nearest_of

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "optimization_level": 3})

EPS = wp.constant(1.0e-12)  # [m²], as in `minimize.safe_norm`
Slope = wp.types.vector(length=7, dtype=wp.float32)
Sum = wp.types.vector(length=8, dtype=wp.float64)


@wp.struct
@no_type_check
class Asked:
    """Which objects are asked for, and by whom; poses are flat over starts, then asked objects."""

    pose: wp.array(dtype=Slope)
    """Place [m], yaw [rad], logarithms of the scale of each object."""
    item: wp.array(dtype=wp.int64)
    """Object of each row of the others."""
    points: wp.array2d(dtype=wp.vec3)
    """In the world, by asked object [m]."""
    weight: wp.array2d(dtype=wp.float32)
    """Of each point; 0 leaves it out."""
    first: wp.array(dtype=wp.int32)
    """First point of each asked object that may have a weight."""
    stop: wp.array(dtype=wp.int32)
    """The point after the last one."""


@wp.struct
@no_type_check
class Pose:
    """Where an object stands."""

    place: wp.vec3
    turn: wp.mat33
    scale: wp.vec3


@wp.func
@no_type_check
def pose_of(row: Slope) -> Pose:
    """The pose of a row of numbers."""
    p = Pose()
    c = wp.cos(row[3])
    s = wp.sin(row[3])
    p.turn = wp.mat33(c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c)
    p.place = wp.vec3(row[0], row[1], row[2])
    p.scale = wp.vec3(wp.exp(row[4]), wp.exp(row[5]), wp.exp(row[6]))
    return p


@wp.func
@no_type_check
def gap_of(off: wp.vec3, arm: wp.vec3, weight: float) -> Sum:
    """Length, and its change with the pose, from an offset and an arm in the object's axes."""
    length = wp.sqrt(wp.length_sq(off) + EPS)
    force = off * (weight / length)
    size = wp.cw_mul(force, arm)
    turn = arm[2] * force[0] - arm[0] * force[2]
    gap = weight * (length - wp.sqrt(EPS))
    return Sum(
        wp.float64(gap),
        wp.float64(force[0]),
        wp.float64(force[1]),
        wp.float64(force[2]),
        wp.float64(turn),
        wp.float64(size[0]),
        wp.float64(size[1]),
        wp.float64(size[2]),
    )


@wp.func
@no_type_check
def say(
    p: Pose, total: Sum, row: int, price: wp.array(dtype=wp.float32), slope: wp.array(dtype=Slope)
) -> None:
    """Enter a sum; the change with the place is turned into the world."""
    t = p.turn * wp.vec3(wp.float32(total[1]), wp.float32(total[2]), wp.float32(total[3]))
    price[row] = price[row] + wp.float32(total[0])
    slope[row] = slope[row] + Slope(
        t[0],
        t[1],
        t[2],
        wp.float32(total[4]),
        wp.float32(total[5]),
        wp.float32(total[6]),
        wp.float32(total[7]),
    )


@wp.kernel
@no_type_check
def from_world(
    a: Asked,
    c: Cloud,
    first_row: int,
    price: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=Slope),
) -> None:
    """Add the weighted distances from points of the world to the object's nearest points."""
    row = first_row + wp.tid()
    asked = row % a.item.shape[0]
    p = pose_of(a.pose[row])
    back = wp.transpose(p.turn)
    q = Query()
    q.item = int(a.item[asked])
    q.scale = p.scale
    guess = int(-1)
    total = Sum()
    for k in range(a.first[asked], a.stop[asked]):
        weight = a.weight[asked, k]
        if weight > 0.0:
            q.place = back * (a.points[asked, k] - p.place)
            guess = nearest_of(c, q, guess)
            arm = wp.cw_mul(c.points[q.item, guess], p.scale)
            total += gap_of(arm - q.place, arm, weight)
    if guess >= 0:
        say(p, total, row, price, slope)


@wp.kernel
@no_type_check
def from_object(
    a: Asked,
    held: wp.array2d(dtype=wp.vec3),
    world: Cloud,
    first_row: int,
    price: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=Slope),
) -> None:
    """Add the mean distance from an object's points to the nearest point of the world.

    Args:
        a: Only poses, objects and ranges are read; an empty range asks for nothing.
        held: Points of the objects in their own axes [m].
        world: Points of the world by object [m].
        first_row: The first row that is priced.
        price: Added to.
        slope: Added to.
    """
    row = first_row + wp.tid()
    asked = row % a.item.shape[0]
    if a.first[asked] < a.stop[asked]:
        p = pose_of(a.pose[row])
        back = wp.transpose(p.turn)
        q = Query()
        q.item = int(a.item[asked])
        q.scale = wp.vec3(1.0, 1.0, 1.0)
        guess = int(-1)
        share = 1.0 / float(held.shape[1])
        total = Sum()
        for k in range(held.shape[1]):
            arm = wp.cw_mul(held[q.item, k], p.scale)
            q.place = p.turn * arm + p.place
            guess = nearest_of(world, q, guess)
            off = back * (q.place - world.points[q.item, guess])
            total += gap_of(off, arm, share)
        say(p, total, row, price, slope)
