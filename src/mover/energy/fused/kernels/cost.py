"""Eq. 1 in its robust form, with its gradient, for one item after the other: for CPUs.

All terms and the change of each with the pose are found in one go, in memory that stays in the
cache; no image is kept. Items share nothing, so that results do not depend on who has them.
"""

import warp as wp

from mover.energy.fused.kernels.cover import (
    BACK,
    FAR,
    FRONT,
    Extent,
    clear,
    face_all,
    flood,
    put,
    walls,
)
from mover.energy.fused.kernels.given import (
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
    Given,
    Pose,
    Slope,
    Workspace,
    pose_of,
    say,
)
from mover.energy.fused.kernels.order import depth_cost, draw_fronts
from mover.energy.fused.kernels.outline import add_cuts, enter, list_cuts, pull_cuts
from mover.energy.fused.kernels.simple import (
    box_cost,
    collision_cost,
    contact_cost,
    distance_cost,
    heading_cost,
    scale_cost,
)

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "optimization_level": 3})


@wp.func
def draw_outline(given: Given, work: Workspace, p: Pose, box: wp.vec4i) -> int:
    """The sum of the squares under each shift, in `squares`; the number of cuts that count."""
    things = given.things.starts.shape[0] - 1
    for k in range(given.windows.shifts.shape[0]):
        work.squares[k] = given.windows.empty[k * things + p.thing]
    edges = walls(given, work, p, FRONT)
    flood(given, work, p, box, work.seen)
    cuts = list_cuts(work, enter(given, work, p, edges))
    add_cuts(given, work, p, cuts)
    clear(work, work.seen, box)
    return cuts


@wp.func
def outline_cost(given: Given, work: Workspace, p: Pose, number: int) -> float:
    """The silhouette term under a shift, by its number."""
    things = given.things.starts.shape[0] - 1
    shift = given.windows.shifts[number]
    trust = given.windows.trust[number * things + p.thing]
    return float(work.squares[number]) * trust + given.windows.loose * shift * shift


@wp.func
def choose(given: Given, work: Workspace, p: Pose, e: Extent) -> int:
    """The number of the shift at which box and silhouette cost least."""
    best = int(0)
    least = float(FAR)
    for k in range(given.windows.shifts.shape[0]):
        box, _ = box_cost(given, work, p, e, given.windows.shifts[k])
        cost = given.weights[BBOX] * box + given.weights[SILHOUETTE] * outline_cost(
            given, work, p, k
        )
        if cost < least:
            least = cost
            best = k
    return best


@wp.func
def look_depth(
    given: Given, work: Workspace, p: Pose, box: wp.vec4i, neither: int
) -> tuple[float, Slope]:
    """The term of the depth order; a depth counts where a back is seen too.

    Where each face is a front or a back, the outlines of both are one.
    """
    if neither > 0:
        walls(given, work, p, BACK)
        flood(given, work, p, box, work.behind)
    b = given.windows.bounded[p.thing]
    drawn = wp.vec4i(
        wp.max(b[0], box[0]), wp.min(b[1], box[1]), wp.max(b[2], box[2]), wp.min(b[3], box[3])
    )
    draw_fronts(given, work, p, drawn)
    cost, slope = depth_cost(given, work, p, drawn, neither == 0)
    if neither > 0:
        clear(work, work.behind, box)
    order = given.facts[p.thing, ORDER]
    return float(cost) * order, slope * order


@wp.func
def look(given: Given, work: Workspace, answer: Answer, p: Pose) -> None:
    """The terms of the image, and that of the depth order."""
    w = given.weights
    e = put(given, work, p)
    b = given.windows.bounded[p.thing]
    bounded = w[DEPTH] != 0.0 and b[0] < b[1]
    neither = int(0)
    wider = float(0.0)
    if w[SILHOUETTE] != 0.0 or bounded:
        neither = face_all(given, work, p)
    if w[SILHOUETTE] != 0.0:
        cuts = draw_outline(given, work, p, e.box)
        best = choose(given, work, p, e)
        wider = given.windows.shifts[best]
        things = given.things.starts.shape[0] - 1
        trust = given.windows.trust[best * things + p.thing]
        slope = pull_cuts(given, work, p, cuts, best) * trust
        cost = outline_cost(given, work, p, best)
        say(answer, p, SILHOUETTE, w[SILHOUETTE] * cost, w[SILHOUETTE] * slope)
    if w[BBOX] != 0.0:
        cost, slope = box_cost(given, work, p, e, wider)
        say(answer, p, BBOX, w[BBOX] * cost, w[BBOX] * slope)
    if bounded:
        cost, slope = look_depth(given, work, p, e.box, neither)
        say(answer, p, DEPTH, w[DEPTH] * cost, w[DEPTH] * slope)


@wp.func
def feel(given: Given, answer: Answer, p: Pose) -> None:
    """The terms of the people, but for the depth order."""
    w = given.weights
    if w[COLLISION] != 0.0:
        cost, slope = collision_cost(given, p)
        many = w[COLLISION] * given.facts[p.thing, BUMP]
        say(answer, p, COLLISION, many * cost, many * slope)
    if w[CONTACT] != 0.0:
        cost, slope = contact_cost(given, p)
        say(answer, p, CONTACT, w[CONTACT] * cost, w[CONTACT] * slope)
    if w[HEADING] != 0.0:
        cost, slope = heading_cost(given, p)
        say(answer, p, HEADING, w[HEADING] * cost, w[HEADING] * slope)


@wp.func
def cost_one(given: Given, work: Workspace, answer: Answer, item: int) -> None:
    """All terms of one item."""
    p = pose_of(given, answer.layout, item)
    answer.whole[item] = 0.0
    answer.slope[item] = Slope()
    for k in range(8):
        answer.parts[item, k] = 0.0
        answer.slopes[item, k] = Slope()
    look(given, work, answer, p)
    feel(given, answer, p)
    w = given.weights
    if w[SCALE] != 0.0:
        l = answer.layout
        cost, slope = scale_cost(given, wp.vec3(l[item, 4], l[item, 5], l[item, 6]))
        say(answer, p, SCALE, w[SCALE] * cost, w[SCALE] * slope)
    if w[DISTANCE] != 0.0:
        cost, slope = distance_cost(given, p)
        say(answer, p, DISTANCE, w[DISTANCE] * cost, w[DISTANCE] * slope)


@wp.kernel
def cost_items(given: Given, work: Workspace, answer: Answer, first: int, stop: int) -> None:
    """All terms of some items, in their order."""
    for i in range(first, stop):
        cost_one(given, work, answer, answer.order[i])
