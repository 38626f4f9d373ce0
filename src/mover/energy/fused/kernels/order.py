"""The cost of depths out of their bounds (`terms.depth`, robust form) and its gradient."""

import warp as wp

from mover.energy.fused.kernels.cover import FRONT, is_marked
from mover.energy.fused.kernels.given import FACES, Given, Pose, Slope, Workspace, slope_of
from mover.geometry.kernels.spans import fill, run_of, triangle
from mover.geometry.kernels.surface import AGREE, GRAZING, face_of, inverse_depth

UNKNOWN = 1.0e29  # [m], a lower bound above it stands for a pixel that has none


@wp.func
def draw_fronts(given: Given, work: Workspace, p: Pose, box: wp.vec4i) -> None:
    """Draw the fronts in a box."""
    first = given.things.starts[p.thing, FACES]
    for f in range(given.things.starts[p.thing + 1, FACES] - first):
        if work.scratch.front[f] == FRONT:
            face = given.things.faces[first + f]
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
    given: Given, work: Workspace, p: Pose, at: wp.vec2i, code: wp.uint64
) -> tuple[float, Slope]:
    """How far the depth of a pixel is out of its bounds, and the change of that."""
    pixel = p.thing * work.scene.height * work.scene.width + at[0] * work.scene.width + at[1]
    limit = given.windows.limit
    z = 1.0 / inverse_depth(code, False)
    under = wp.max(given.windows.lower[pixel] - z, 0.0)
    over = wp.max(z - given.windows.upper[pixel], 0.0)
    up = wp.where(over > 0.0 and over < limit, 1.0, 0.0)
    up -= wp.where(under > 0.0 and under < limit, 1.0, 0.0)
    slope = Slope()
    if up != 0.0:
        lens = work.scene.window[0]
        x = (float(at[1]) + 0.5 - lens[2]) / lens[0]
        y = (float(at[0]) + 0.5 - lens[3]) / lens[1]
        corner = given.things.faces[given.things.starts[p.thing, FACES] + face_of(code)]
        slope = up * pull_depth(work, p, corner, wp.vec3(x, y, 1.0), z)
    return wp.min(under, limit) + wp.min(over, limit), slope


@wp.func
def depth_cost(
    given: Given, work: Workspace, p: Pose, box: wp.vec4i, closed: bool
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
                if known and given.windows.lower[there + pixel] < UNKNOWN:
                    count += 1.0
                    cost, change = pixel_cost(given, work, p, wp.vec2i(row, column), code)
                    if cost > 0.0:
                        total += wp.float64(cost)
                        slope += change
    share = 1.0 / wp.max(count, given.windows.fewest)
    return total * wp.float64(share), slope * share
