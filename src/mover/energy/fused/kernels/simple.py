"""The costs of boxes, sizes, distances and headings (robust form) and their gradients."""

import warp as wp

from mover.energy.fused.kernels.cover import ScreenExtent
from mover.energy.fused.kernels.data import (
    AWAY,
    FACE_X,
    FACE_Z,
    QUERIES,
    SAMPLES,
    SEATED,
    SIZE,
    VERTS,
    KernelInput,
    Pose,
    Slope,
    Workspace,
    slope_of,
)
from mover.geometry.camera import NEAR
from mover.geometry.kernels.lookup import interpolate


@wp.func
def side_of_box(
    data: KernelInput, work: Workspace, p: Pose, v: int, k: int, wider: float
) -> tuple[float, Slope]:
    """The cost of side k of the box (x_min, y_min, x_max, y_max), at which vertex v lies."""
    axis = k % 2
    at = work.scene.verts[v]
    z = wp.max(at[2], NEAR)
    focal = data.lens[axis]
    size = data.facts[p.thing, SIZE]
    soft = data.soft
    known = data.boxes[p.thing][k] + wp.where(k < 2, -wider, wider)
    off = (at[axis] / z * focal + data.lens[axis + 2] - known) / size
    length = wp.sqrt(off * off + soft * soft)
    outside = off * wp.where(k < 2, -1.0, 1.0) > 0.0
    most = wp.where(outside, data.beyond[p.thing][k], wp.inf)
    cost = length - soft
    share = wp.where(most < wp.inf, most / wp.max(most + cost, 1.0e-9), 1.0)
    counts = data.within[p.thing][k] * share * share
    pull = counts * off / (length * size) * focal / z
    force = wp.vec3(0.0, 0.0, wp.where(at[2] >= NEAR, -at[axis] / z * pull, 0.0))
    force[axis] = pull
    arm = wp.cw_mul(data.things.verts[data.things.starts[p.thing, VERTS] + v], p.scale)
    slope = slope_of(wp.transpose(p.view) * force, arm)
    return data.within[p.thing][k] * share * cost, slope


@wp.func
def box_cost(
    data: KernelInput, work: Workspace, p: Pose, e: ScreenExtent, wider: float
) -> tuple[float, Slope]:
    """How far the drawn box is from the detected one, whose sides are farther out by `wider`."""
    a, da = side_of_box(data, work, p, e.left, 0, wider)
    b, db = side_of_box(data, work, p, e.top, 1, wider)
    c, dc = side_of_box(data, work, p, e.right, 2, wider)
    d, dd = side_of_box(data, work, p, e.bottom, 3, wider)
    return a + b + c + d, da + db + dc + dd


@wp.func
def scale_cost(data: KernelInput, logs: wp.vec3) -> tuple[float, Slope]:
    """How far the size is from the initial one, see `prior_terms`."""
    mean = (logs[0] + logs[1] + logs[2]) / 3.0
    cost = data.growth * mean * mean
    pull = 2.0 / 3.0 * data.growth * mean
    slope = wp.vec3(pull, pull, pull)
    for k in range(3):
        out = wp.max(logs[k] - data.sizes[1], 0.0) + wp.max(data.sizes[0] - logs[k], 0.0)
        sign = wp.where(
            logs[k] > data.sizes[1], 20.0, wp.where(logs[k] < data.sizes[0], -20.0, 0.0)
        )
        cost += (logs[k] - mean) * (logs[k] - mean) + 10.0 * out * out
        slope[k] += 2.0 * (logs[k] - mean) + sign * out
    return cost, Slope(0.0, 0.0, 0.0, 0.0, slope[0], slope[1], slope[2], 0.0, 0.0)


@wp.func
def distance_cost(data: KernelInput, p: Pose) -> tuple[float, Slope]:
    """Cost of another distance from the camera than the given one."""
    squared = wp.length_sq(p.place)
    off = 0.5 * wp.log(wp.max(squared, 1.0e-6)) - data.facts[p.thing, AWAY]
    rho2 = data.rho * data.rho
    whole = off * off + rho2
    pull = wp.where(squared >= 1.0e-6, 2.0 * off * rho2 / (whole * whole * squared), 0.0)
    force = wp.transpose(p.turn) * (pull * p.place)
    return off * off / whole, Slope(force[0], force[1], force[2], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.func
def heading_cost(data: KernelInput, p: Pose) -> tuple[float, Slope]:
    """One less the cosine between a seat and its sitters."""
    x = data.facts[p.thing, FACE_X]
    z = data.facts[p.thing, FACE_Z]
    s = p.turn[0, 2]
    c = p.turn[0, 0]
    seated = data.facts[p.thing, SEATED]
    turn = seated * (s * z - c * x)
    return seated * (1.0 - s * x - c * z), Slope(0.0, 0.0, 0.0, turn, 0.0, 0.0, 0.0, 0.0, 0.0)


CALM = wp.constant(wp.uint8(2))  # a brick without bodies
BRICK = wp.constant(3)  # bits, as in `lookup`
EPS = wp.constant(1.0e-12)  # [m²], as in `minimize.safe_norm`


@wp.func
def nearest_of(points: wp.array2d(dtype=wp.vec3), p: Pose, at: wp.vec3) -> wp.vec3:
    """The point of an object's part that is nearest to a position, the first of equals."""
    near = points[p.thing, 0]
    best = wp.length_sq(wp.cw_mul(near, p.scale) - at)
    for k in range(1, points.shape[1]):
        d = wp.length_sq(wp.cw_mul(points[p.thing, k], p.scale) - at)
        if d < best:
            best = d
            near = points[p.thing, k]
    return near


@wp.func
def contact_cost(data: KernelInput, p: Pose) -> tuple[float, Slope]:
    """Robust cost of the distance of the skin that touches, and its change."""
    total = wp.float64(0.0)
    slope = Slope()
    back = wp.transpose(p.turn)
    first = data.things.starts[p.thing, QUERIES]
    rho2 = data.people.rho * data.people.rho
    for k in range(first, data.things.starts[p.thing + 1, QUERIES]):
        at = back * (data.people.queries[k] - p.place)
        share = data.people.share[k]
        near = wp.vec3()
        if share > 0.0:
            near = nearest_of(data.people.top, p, at)
        else:
            near = nearest_of(data.people.back, p, at)
        arm = wp.cw_mul(near, p.scale)
        off = at - arm
        length = wp.sqrt(wp.length_sq(off) + EPS)
        gap = length - wp.sqrt(EPS)
        whole = gap * gap + rho2
        share = wp.abs(share)
        total += wp.float64(share * gap * gap / whole)
        force = -share * 2.0 * gap * rho2 / (whole * whole * length)
        slope += slope_of(force * off, arm)
    return float(total), slope


@wp.func
def collision_cost(data: KernelInput, p: Pose) -> tuple[float, Slope]:
    """Sum of the squared depths of the surface inside bodies [m²], and its change."""
    total = wp.float64(0.0)
    slope = Slope()
    f = data.people.field
    back = wp.transpose(p.turn)
    top = wp.vec3(
        float(f.values.shape[0] - 1), float(f.values.shape[1] - 1), float(f.values.shape[2] - 1)
    )
    last = wp.vec3i(f.values.shape[0] - 2, f.values.shape[1] - 2, f.values.shape[2] - 2)
    first = data.things.starts[p.thing, SAMPLES]
    for k in range(first, data.things.starts[p.thing + 1, SAMPLES]):
        arm = wp.cw_mul(data.things.samples[k], p.scale)
        at = (p.turn * arm + p.place - f.origin) / f.cell
        if wp.min(at) >= 0.0 and wp.min(top - at) >= 0.0:
            cell = wp.min(wp.vec3i(int(at[0]), int(at[1]), int(at[2])), last)
            if f.busy[cell[0] >> BRICK, cell[1] >> BRICK, cell[2] >> BRICK] != CALM:
                t = wp.vec3(at[0] - float(cell[0]), at[1] - float(cell[1]), at[2] - float(cell[2]))
                r = interpolate(f, cell, t)
                if r[3] < 0.0:
                    total += wp.float64(r[3] * r[3])
                    force = wp.vec3(r[0], r[1], r[2]) * (2.0 * r[3] / f.cell)
                    slope += slope_of(back * force, arm)
    return float(total), slope
