"""Eq. 1 in its robust form, with its gradient, for one item after the other: for CPUs.

All terms and the change of each with the pose are found in one go, in memory that stays in the
cache; no image is kept. Items share nothing, so that results do not depend on who has them.
"""

import warp as wp

from mover.energy.fused.kernels.cover import (
    BACK,
    FAR,
    FRONT,
    ScreenExtent,
    clear,
    face_all,
    flood,
    is_marked,
    put,
    walls,
)
from mover.energy.fused.kernels.data import (
    BBOX,
    BUMP,
    COLLISION,
    CONTACT,
    DEPTH,
    DISTANCE,
    FACES,
    HEADING,
    SCALE,
    SILHOUETTE,
    ItemCosts,
    KernelInput,
    Pose,
    Slope,
    Workspace,
    accumulate,
    pose_of,
    slope_of,
)
from mover.energy.fused.kernels.outline import add_cuts, enter, list_cuts, pull_cuts
from mover.energy.fused.kernels.simple import (
    box_cost,
    collision_cost,
    contact_cost,
    distance_cost,
    heading_cost,
    scale_cost,
)
from mover.geometry.kernels.spans import fill, run_of, triangle
from mover.geometry.kernels.surface import AGREE, GRAZING, face_of, inverse_depth

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "optimization_level": 3})


@wp.func
def draw_outline(data: KernelInput, work: Workspace, p: Pose, box: wp.vec4i) -> int:
    """The sum of the squares under each shift, in `squares`; the number of cuts that count."""
    things = data.things.starts.shape[0] - 1
    for k in range(data.windows.shifts.shape[0]):
        work.squares[k] = data.windows.empty[k * things + p.thing]
    edges = walls(data, work, p, FRONT)
    flood(data, work, p, box, work.seen)
    cuts = list_cuts(work, enter(data, work, p, edges))
    add_cuts(data, work, p, cuts)
    clear(work, work.seen, box)
    return cuts


@wp.func
def outline_cost(data: KernelInput, work: Workspace, p: Pose, number: int) -> float:
    """The silhouette term under a shift, by its number."""
    things = data.things.starts.shape[0] - 1
    shift = data.windows.shifts[number]
    trust = data.windows.trust[number * things + p.thing]
    return float(work.squares[number]) * trust + data.windows.loose * shift * shift


@wp.func
def choose(data: KernelInput, work: Workspace, p: Pose, e: ScreenExtent) -> int:
    """The number of the shift at which box and silhouette cost least."""
    best = int(0)
    least = float(FAR)
    for k in range(data.windows.shifts.shape[0]):
        box, _ = box_cost(data, work, p, e, data.windows.shifts[k])
        cost = data.weights[BBOX] * box + data.weights[SILHOUETTE] * outline_cost(data, work, p, k)
        if cost < least:
            least = cost
            best = k
    return best


@wp.func
def look_depth(
    data: KernelInput, work: Workspace, p: Pose, box: wp.vec4i, neither: int
) -> tuple[float, Slope]:
    """The term of the depth order; a depth counts where a back is seen too.

    Where each face is a front or a back, the outlines of both are one.
    """
    if neither > 0:
        walls(data, work, p, BACK)
        flood(data, work, p, box, work.behind)
    b = data.windows.bounded[p.thing]
    drawn = wp.vec4i(
        wp.max(b[0], box[0]), wp.min(b[1], box[1]), wp.max(b[2], box[2]), wp.min(b[3], box[3])
    )
    draw_fronts(data, work, p, drawn)
    cost, slope = depth_cost(data, work, p, drawn, neither == 0)
    if neither > 0:
        clear(work, work.behind, box)
    return float(cost), slope


@wp.func
def add_image_terms(data: KernelInput, work: Workspace, answer: ItemCosts, p: Pose) -> None:
    """The terms of the image, and that of the depth order."""
    w = data.weights
    e = put(data, work, p)
    b = data.windows.bounded[p.thing]
    bounded = w[DEPTH] != 0.0 and b[0] < b[1]
    neither = int(0)
    wider = float(0.0)
    if w[SILHOUETTE] != 0.0 or bounded:
        neither = face_all(data, work, p)
    if w[SILHOUETTE] != 0.0:
        cuts = draw_outline(data, work, p, e.box)
        best = choose(data, work, p, e)
        wider = data.windows.shifts[best]
        things = data.things.starts.shape[0] - 1
        trust = data.windows.trust[best * things + p.thing]
        slope = pull_cuts(data, work, p, cuts, best) * trust
        cost = outline_cost(data, work, p, best)
        accumulate(answer, p, SILHOUETTE, w[SILHOUETTE] * cost, w[SILHOUETTE] * slope)
    if w[BBOX] != 0.0:
        cost, slope = box_cost(data, work, p, e, wider)
        accumulate(answer, p, BBOX, w[BBOX] * cost, w[BBOX] * slope)
    if bounded:
        cost, slope = look_depth(data, work, p, e.box, neither)
        accumulate(answer, p, DEPTH, w[DEPTH] * cost, w[DEPTH] * slope)


@wp.func
def add_human_terms(data: KernelInput, answer: ItemCosts, p: Pose) -> None:
    """The terms of the people, but for the depth order."""
    w = data.weights
    if w[COLLISION] != 0.0:
        cost, slope = collision_cost(data, p)
        many = w[COLLISION] * data.facts[p.thing, BUMP]
        accumulate(answer, p, COLLISION, many * cost, many * slope)
    if w[CONTACT] != 0.0:
        cost, slope = contact_cost(data, p)
        accumulate(answer, p, CONTACT, w[CONTACT] * cost, w[CONTACT] * slope)
    if w[HEADING] != 0.0:
        cost, slope = heading_cost(data, p)
        accumulate(answer, p, HEADING, w[HEADING] * cost, w[HEADING] * slope)


@wp.func
def cost_one(data: KernelInput, work: Workspace, answer: ItemCosts, item: int) -> None:
    """All terms of one item."""
    p = pose_of(data, answer.layout, item)
    answer.whole[item] = 0.0
    answer.slope[item] = Slope()
    for k in range(8):
        answer.parts[item, k] = 0.0
        answer.slopes[item, k] = Slope()
    add_image_terms(data, work, answer, p)
    add_human_terms(data, answer, p)
    w = data.weights
    if w[SCALE] != 0.0:
        l = answer.layout
        cost, slope = scale_cost(data, wp.vec3(l[item, 4], l[item, 5], l[item, 6]))
        accumulate(answer, p, SCALE, w[SCALE] * cost, w[SCALE] * slope)
    if w[DISTANCE] != 0.0:
        cost, slope = distance_cost(data, p)
        accumulate(answer, p, DISTANCE, w[DISTANCE] * cost, w[DISTANCE] * slope)


@wp.kernel
def cost_items(
    data: KernelInput, work: Workspace, answer: ItemCosts, first: int, stop: int
) -> None:
    """All terms of some items, in their order."""
    for i in range(first, stop):
        cost_one(data, work, answer, answer.order[i])


UNKNOWN = 1.0e29  # [m], a lower bound above it stands for a pixel that has none


@wp.func
def draw_fronts(data: KernelInput, work: Workspace, p: Pose, box: wp.vec4i) -> None:
    """Draw the fronts in a box."""
    first = data.things.starts[p.thing, FACES]
    for f in range(data.things.starts[p.thing + 1, FACES] - first):
        if work.scratch.front[f] == FRONT:
            face = data.things.faces[first + f]
            a = work.scratch.screen[face[0]]
            b = work.scratch.screen[face[1]]
            c = work.scratch.screen[face[2]]
            wide = wp.vec3l(wp.int64(face[0]), wp.int64(face[1]), wp.int64(face[2]))
            t = triangle(a, b, c, wide, box)
            for row in range(t.first, t.last + 1):
                r = run_of(t, row, box[2], box[3])
                fill(work.scratch.near, row * work.scene.width, r, f + 1)


@wp.func
def pull_depth(work: Workspace, p: Pose, corner: wp.vec3i, ray: wp.vec3, z: float) -> Slope:
    """Change of the depth of a ray with the pose, as in `surface.pull_depth`."""
    a = work.scene.verts[corner[0]]
    normal = wp.cross(work.scene.verts[corner[1]] - a, work.scene.verts[corner[2]] - a)
    toward = wp.dot(normal, a)
    slant = wp.dot(normal, ray)
    steep = toward * toward > GRAZING * GRAZING * wp.dot(normal, normal) * wp.dot(a, a)
    if steep and wp.isfinite(toward) and wp.abs(slant * z - toward) < AGREE * wp.abs(toward):
        back = wp.transpose(p.view)
        return slope_of(back * (normal / slant), back * (ray * (toward / slant) - p.origin))
    return Slope()


@wp.func
def pixel_cost(
    data: KernelInput, work: Workspace, p: Pose, at: wp.vec2i, code: wp.uint64
) -> tuple[float, Slope]:
    """How far the depth of a pixel is out of its bounds, and the change of that."""
    pixel = p.thing * work.scene.height * work.scene.width + at[0] * work.scene.width + at[1]
    limit = data.windows.limit
    z = 1.0 / inverse_depth(code, False)
    under = wp.max(data.windows.lower[pixel] - z, 0.0)
    over = wp.max(z - data.windows.upper[pixel], 0.0)
    up = wp.where(over > 0.0 and over < limit, 1.0, 0.0)
    up -= wp.where(under > 0.0 and under < limit, 1.0, 0.0)
    slope = Slope()
    if up != 0.0:
        lens = work.scene.window[0]
        x = (float(at[1]) + 0.5 - lens[2]) / lens[0]
        y = (float(at[0]) + 0.5 - lens[3]) / lens[1]
        corner = data.things.faces[data.things.starts[p.thing, FACES] + face_of(code)]
        slope = up * pull_depth(work, p, corner, wp.vec3(x, y, 1.0), z)
    return wp.min(under, limit) + wp.min(over, limit), slope


@wp.func
def depth_cost(
    data: KernelInput, work: Workspace, p: Pose, box: wp.vec4i, closed: bool
) -> tuple[wp.float64, Slope]:
    """How far the depths in a box are out of their bounds, for each that has any, and the change.

    What is drawn is taken away. Where all is closed there is a back wherever there is a front;
    else it is looked up.
    """
    total = wp.float64(0.0)
    slope = Slope()
    count = float(0.0)
    there = p.thing * work.scene.height * work.scene.width
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            pixel = row * work.scene.width + column
            code = work.scratch.near[pixel]
            if code != wp.uint64(0):
                work.scratch.near[pixel] = wp.uint64(0)
                known = closed or is_marked(work, work.behind, row, column)
                if known and data.windows.lower[there + pixel] < UNKNOWN:
                    count += 1.0
                    cost, change = pixel_cost(data, work, p, wp.vec2i(row, column), code)
                    if cost > 0.0:
                        total += wp.float64(cost)
                        slope += change
    share = 1.0 / wp.max(count, data.windows.fewest)
    return total * wp.float64(share), slope * share
