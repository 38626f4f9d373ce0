# pyright: basic, reportInvalidTypeForm=false
"""The prices of contact and of collision (robust form) and their gradients."""

from typing import no_type_check

import warp as wp

from .given import ASKED, SAMPLES, Given, Pose, Slope, slope_of
from .lookup import interpolate
from .nearest import Query, nearest_of

CALM = wp.constant(wp.uint8(2))  # a brick without bodies
BRICK = wp.constant(3)  # bits, as in `lookup`
EPS = wp.constant(1.0e-12)  # [m²], as in `minimize.safe_norm`


@wp.func
@no_type_check
def price_contact(given: Given, p: Pose) -> tuple[float, Slope]:
    """Robust price of the distance of the skin that touches, and its change."""
    total = wp.float64(0.0)
    slope = Slope()
    q = Query()
    q.item = p.thing
    q.scale = p.scale
    back = wp.transpose(p.turn)
    first = given.things.starts[p.thing, ASKED]
    held = p.item / (given.things.starts.shape[0] - 1) * given.people.asked.shape[0]
    rho2 = given.people.rho * given.people.rho
    for k in range(first, given.things.starts[p.thing + 1, ASKED]):
        q.place = back * (given.people.asked[k] - p.place)
        share = given.people.share[k]
        near = wp.vec3()
        if share > 0.0:
            place = nearest_of(given.people.top, q, given.people.held[held + k])
            near = given.people.top.points[p.thing, place]
        else:
            place = nearest_of(given.people.back, q, given.people.held[held + k])
            near = given.people.back.points[p.thing, place]
        given.people.held[held + k] = place
        arm = wp.cw_mul(near, p.scale)
        off = q.place - arm
        length = wp.sqrt(wp.length_sq(off) + EPS)
        gap = length - wp.sqrt(EPS)
        whole = gap * gap + rho2
        share = wp.abs(share)
        total += wp.float64(share * gap * gap / whole)
        force = -share * 2.0 * gap * rho2 / (whole * whole * length)
        slope += slope_of(force * off, arm)
    return float(total), slope


@wp.func
@no_type_check
def price_collision(given: Given, p: Pose) -> tuple[float, Slope]:
    """Sum of the squared depths of the surface inside bodies [m²], and its change."""
    total = wp.float64(0.0)
    slope = Slope()
    f = given.people.field
    back = wp.transpose(p.turn)
    top = wp.vec3(
        float(f.values.shape[0] - 1), float(f.values.shape[1] - 1), float(f.values.shape[2] - 1)
    )
    last = wp.vec3i(f.values.shape[0] - 2, f.values.shape[1] - 2, f.values.shape[2] - 2)
    first = given.things.starts[p.thing, SAMPLES]
    for k in range(first, given.things.starts[p.thing + 1, SAMPLES]):
        arm = wp.cw_mul(given.things.samples[k], p.scale)
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
