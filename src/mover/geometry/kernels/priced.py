# pyright: basic, reportInvalidTypeForm=false
"""Eq. 1 in its robust form, with its gradient, for one item after the other: for CPUs.

All terms and the change of each with the pose are found in one go, in memory that stays in the
cache; no image is kept. Items share nothing, so that results do not depend on who has them.
"""

from typing import no_type_check

import warp as wp

from .cover import BACK, FAR, FRONT, Extent, clear, face_all, flood, put, walls
from .given import (
    BBOX,
    BUMP,
    COLLISION,
    CONTACT,
    DEPTH,
    DISTANCE,
    HEADING,
    ORDER,
    SCALE,
    SILHOUETTE,
    Answer,
    Desk,
    Given,
    Pose,
    Slope,
    pose_of,
    say,
)
from .order import draw_fronts, price_depths
from .outline import enter, list_cuts, price_cuts, pull_cuts
from .simple import price_box, price_distance, price_heading, price_scale
from .touched import price_collision, price_contact

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "optimization_level": 3})


@wp.func
@no_type_check
def draw_outline(given: Given, desk: Desk, p: Pose, box: wp.vec4i) -> int:
    """The sum of the squares under each shift, in `squares`; the number of cuts that count."""
    things = given.things.starts.shape[0] - 1
    for k in range(given.windows.shifts.shape[0]):
        desk.squares[k] = given.windows.empty[k * things + p.thing]
    edges = walls(given, desk, p, FRONT)
    flood(given, desk, p, box, desk.seen)
    cuts = list_cuts(desk, enter(given, desk, p, edges))
    price_cuts(given, desk, p, cuts)
    clear(desk, desk.seen, box)
    return cuts


@wp.func
@no_type_check
def price_outline(given: Given, desk: Desk, p: Pose, number: int) -> float:
    """The silhouette term under a shift, by its number."""
    things = given.things.starts.shape[0] - 1
    shift = given.windows.shifts[number]
    trust = given.windows.trust[number * things + p.thing]
    return float(desk.squares[number]) * trust + given.windows.loose * shift * shift


@wp.func
@no_type_check
def choose(given: Given, desk: Desk, p: Pose, e: Extent) -> int:
    """The number of the shift at which box and silhouette cost least."""
    best = int(0)
    least = float(FAR)
    for k in range(given.windows.shifts.shape[0]):
        price, _ = price_box(given, desk, p, e, given.windows.shifts[k])
        cost = given.weights[BBOX] * price + given.weights[SILHOUETTE] * price_outline(
            given, desk, p, k
        )
        if cost < least:
            least = cost
            best = k
    return best


@wp.func
@no_type_check
def look_depth(
    given: Given, desk: Desk, p: Pose, box: wp.vec4i, neither: int
) -> tuple[float, Slope]:
    """The term of the depth order; a depth counts where a back is seen too.

    Where each face is a front or a back, the outlines of both are one.
    """
    if neither > 0:
        walls(given, desk, p, BACK)
        flood(given, desk, p, box, desk.behind)
    b = given.windows.bounded[p.thing]
    drawn = wp.vec4i(
        wp.max(b[0], box[0]), wp.min(b[1], box[1]), wp.max(b[2], box[2]), wp.min(b[3], box[3])
    )
    draw_fronts(given, desk, p, drawn)
    price, slope = price_depths(given, desk, p, drawn, neither == 0)
    if neither > 0:
        clear(desk, desk.behind, box)
    order = given.facts[p.thing, ORDER]
    return float(price) * order, slope * order


@wp.func
@no_type_check
def look(given: Given, desk: Desk, answer: Answer, p: Pose) -> None:
    """The terms of the image, and that of the depth order."""
    w = given.weights
    e = put(given, desk, p)
    b = given.windows.bounded[p.thing]
    bounded = w[DEPTH] != 0.0 and b[0] < b[1]
    neither = int(0)
    wider = float(0.0)
    if w[SILHOUETTE] != 0.0 or bounded:
        neither = face_all(given, desk, p)
    if w[SILHOUETTE] != 0.0:
        cuts = draw_outline(given, desk, p, e.box)
        best = choose(given, desk, p, e)
        wider = given.windows.shifts[best]
        things = given.things.starts.shape[0] - 1
        trust = given.windows.trust[best * things + p.thing]
        slope = pull_cuts(given, desk, p, cuts, best) * trust
        price = price_outline(given, desk, p, best)
        say(answer, p, SILHOUETTE, w[SILHOUETTE] * price, w[SILHOUETTE] * slope)
    if w[BBOX] != 0.0:
        price, slope = price_box(given, desk, p, e, wider)
        say(answer, p, BBOX, w[BBOX] * price, w[BBOX] * slope)
    if bounded:
        price, slope = look_depth(given, desk, p, e.box, neither)
        say(answer, p, DEPTH, w[DEPTH] * price, w[DEPTH] * slope)


@wp.func
@no_type_check
def feel(given: Given, answer: Answer, p: Pose) -> None:
    """The terms of the people, but for the depth order."""
    w = given.weights
    if w[COLLISION] != 0.0:
        price, slope = price_collision(given, p)
        many = w[COLLISION] * given.facts[p.thing, BUMP]
        say(answer, p, COLLISION, many * price, many * slope)
    if w[CONTACT] != 0.0:
        price, slope = price_contact(given, p)
        say(answer, p, CONTACT, w[CONTACT] * price, w[CONTACT] * slope)
    if w[HEADING] != 0.0:
        price, slope = price_heading(given, p)
        say(answer, p, HEADING, w[HEADING] * price, w[HEADING] * slope)


@wp.func
@no_type_check
def price_one(given: Given, desk: Desk, answer: Answer, item: int) -> None:
    """All terms of one item."""
    p = pose_of(given, answer.layout, item)
    answer.whole[item] = 0.0
    answer.slope[item] = Slope()
    for k in range(8):
        answer.parts[item, k] = 0.0
        answer.slopes[item, k] = Slope()
    look(given, desk, answer, p)
    feel(given, answer, p)
    w = given.weights
    if w[SCALE] != 0.0:
        l = answer.layout
        price, slope = price_scale(given, wp.vec3(l[item, 4], l[item, 5], l[item, 6]))
        say(answer, p, SCALE, w[SCALE] * price, w[SCALE] * slope)
    if w[DISTANCE] != 0.0:
        price, slope = price_distance(given, p)
        say(answer, p, DISTANCE, w[DISTANCE] * price, w[DISTANCE] * slope)


@wp.kernel
@no_type_check
def price_items(given: Given, desk: Desk, answer: Answer, first: int, stop: int) -> None:
    """All terms of some items, in their order."""
    for i in range(first, stop):
        price_one(given, desk, answer, answer.order[i])
