# pyright: basic, reportInvalidTypeForm=false
"""The prices of boxes, sizes, distances and headings (robust form) and their gradients."""

from typing import no_type_check

import warp as wp

from ..camera import NEAR
from .cover import Extent
from .given import AWAY, FACE_X, FACE_Z, SEATED, SIZE, VERTS, Desk, Given, Pose, Slope, slope_of


@wp.func
@no_type_check
def side_of_box(
    given: Given, desk: Desk, p: Pose, v: int, k: int, wider: float
) -> tuple[float, Slope]:
    """The price of side k of the box (x_min, y_min, x_max, y_max), at which vertex v lies."""
    axis = k % 2
    at = desk.scene.verts[v]
    z = wp.max(at[2], NEAR)
    focal = given.lens[axis]
    size = given.facts[p.thing, SIZE]
    soft = given.soft
    known = given.boxes[p.thing][k] + wp.where(k < 2, -wider, wider)
    off = (at[axis] / z * focal + given.lens[axis + 2] - known) / size
    length = wp.sqrt(off * off + soft * soft)
    outside = off * wp.where(k < 2, -1.0, 1.0) > 0.0
    counts = wp.where(outside, given.beyond[p.thing][k], given.within[p.thing][k])
    pull = counts * off / (length * size) * focal / z
    force = wp.vec3(0.0, 0.0, wp.where(at[2] >= NEAR, -at[axis] / z * pull, 0.0))
    force[axis] = pull
    arm = wp.cw_mul(given.things.verts[given.things.starts[p.thing, VERTS] + v], p.scale)
    slope = slope_of(wp.transpose(p.view) * force, arm)
    return counts * (length - soft), slope


@wp.func
@no_type_check
def price_box(given: Given, desk: Desk, p: Pose, e: Extent, wider: float) -> tuple[float, Slope]:
    """How far the drawn box is from the detected one, whose sides are farther out by `wider`."""
    a, da = side_of_box(given, desk, p, e.left, 0, wider)
    b, db = side_of_box(given, desk, p, e.top, 1, wider)
    c, dc = side_of_box(given, desk, p, e.right, 2, wider)
    d, dd = side_of_box(given, desk, p, e.bottom, 3, wider)
    return a + b + c + d, da + db + dc + dd


@wp.func
@no_type_check
def price_scale(given: Given, logs: wp.vec3) -> tuple[float, Slope]:
    """How far the size is from the initial one, see `terms.scale`."""
    mean = (logs[0] + logs[1] + logs[2]) / 3.0
    price = given.growth * mean * mean
    pull = 2.0 / 3.0 * given.growth * mean
    slope = wp.vec3(pull, pull, pull)
    for k in range(3):
        out = wp.max(logs[k] - given.sizes[1], 0.0) + wp.max(given.sizes[0] - logs[k], 0.0)
        sign = wp.where(
            logs[k] > given.sizes[1], 20.0, wp.where(logs[k] < given.sizes[0], -20.0, 0.0)
        )
        price += (logs[k] - mean) * (logs[k] - mean) + 10.0 * out * out
        slope[k] += 2.0 * (logs[k] - mean) + sign * out
    return price, Slope(0.0, 0.0, 0.0, 0.0, slope[0], slope[1], slope[2])


@wp.func
@no_type_check
def price_distance(given: Given, p: Pose) -> tuple[float, Slope]:
    """Price of another distance from the camera than the given one."""
    squared = wp.length_sq(p.place)
    off = 0.5 * wp.log(wp.max(squared, 1.0e-6)) - given.facts[p.thing, AWAY]
    rho2 = given.rho * given.rho
    whole = off * off + rho2
    pull = wp.where(squared >= 1.0e-6, 2.0 * off * rho2 / (whole * whole * squared), 0.0)
    force = wp.transpose(p.turn) * (pull * p.place)
    return off * off / whole, Slope(force[0], force[1], force[2], 0.0, 0.0, 0.0, 0.0)


@wp.func
@no_type_check
def price_heading(given: Given, p: Pose) -> tuple[float, Slope]:
    """One less the cosine between a seat and its sitters."""
    x = given.facts[p.thing, FACE_X]
    z = given.facts[p.thing, FACE_Z]
    s = p.turn[0, 2]
    c = p.turn[0, 0]
    seated = given.facts[p.thing, SEATED]
    turn = seated * (s * z - c * x)
    return seated * (1.0 - s * x - c * z), Slope(0.0, 0.0, 0.0, turn, 0.0, 0.0, 0.0)
