"""The cost of a silhouette (`image_terms`) and its gradient, from the outline alone.

The pixels that the outline moves are counted again; of the others only those that are covered.
"""

import warp as wp

from mover.energy.fused.kernels.cover import FRONT, is_marked
from mover.energy.fused.kernels.data import (
    FACES,
    VERTS,
    KernelInput,
    Pose,
    Slope,
    Workspace,
    slope_of,
)
from mover.geometry.kernels.contour import (
    STEEP,
    Contour,
    Gap,
    contour,
    crossing,
    cut_of,
    gap,
    key,
    pulled,
)


@wp.func
def edge_of_outline(data: KernelInput, work: Workspace, p: Pose, e: int) -> Contour:
    """An edge between a front and what is none."""
    edge = data.things.edges[e]
    front = wp.where(work.scratch.front[edge[2]] == FRONT, edge[2], edge[3])
    face = data.things.faces[data.things.starts[p.thing, FACES] + front]
    wide = wp.vec4l(wp.int64(edge[0]), wp.int64(edge[1]), wp.int64(edge[2]), wp.int64(edge[3]))
    corners = wp.vec3l(wp.int64(face[0]), wp.int64(face[1]), wp.int64(face[2]))
    return contour(work.scene, work.scratch, wide, corners)


@wp.func
def enter(data: KernelInput, work: Workspace, p: Pose, edges: int) -> int:
    """List the cuts of pairs of a covered and an uncovered centre; their number.

    Of each pair, the outermost is remembered.
    """
    n = int(0)
    for i in range(edges):
        e = work.scratch.queue[i]
        c = edge_of_outline(data, work, p, e)
        for line in range(c.first, c.last + 1):
            g = gap(work.scene, c, line)
            if g.distance >= 0.0 and parts(work, c, g, line) and n < work.pairs.shape[0]:
                k = key(g, e)
                work.scratch.cuts[n] = cut_of(work.scene, 0, c, g, line)
                work.pairs[n] = g.pair
                work.keys[n] = k
                n += 1
                if k > work.scratch.pairs[g.pair]:
                    work.scratch.pairs[g.pair] = k
    return n


@wp.func
def parts(work: Workspace, c: Contour, g: Gap, line: int) -> bool:
    """Whether the inner centre is covered and the outer one is not."""
    beyond = g.place + c.outward
    if c.steep:
        inner = is_marked(work, work.seen, line, g.place)
        return inner and not is_marked(work, work.seen, line, beyond)
    inner = is_marked(work, work.seen, g.place, line)
    return inner and not is_marked(work, work.seen, beyond, line)


@wp.func
def list_cuts(work: Workspace, found: int) -> int:
    """Keep the cuts that count, and add up what they change; their number."""
    n = int(0)
    for i in range(found):
        pair = work.pairs[i]
        if work.scratch.pairs[pair] == work.keys[i]:
            work.scratch.pairs[pair] = wp.uint64(0)
            cut = work.scratch.cuts[i]
            x = crossing(work.scene, cut)
            if x.target >= 0:
                border = work.scene.border  # from the window's pixel to that of the grid
                wide = work.scene.width - 2 * border
                row = x.target / wide + border
                target = row * work.scene.width + x.target % wide + border
                covered = wp.where(x.shift < 0.0, 1.0, 0.0)
                work.scratch.cuts[n] = cut
                work.scratch.targets[n] = target
                work.crossings[n] = wp.vec4(x.share, x.slope, x.outward, covered)
                work.shift[target] = work.shift[target] + x.shift
                n += 1
    return n


@wp.func
def pull_cuts(data: KernelInput, work: Workspace, p: Pose, cuts: int, number: int) -> Slope:
    """Change of the sum of squares under a shift, by its number, with the pose."""
    total = Slope()
    lens = work.scene.window[0]
    there = p.thing * work.scene.height * work.scene.width
    shifted = pane_of(data, work, p, number)
    verts = data.things.starts[p.thing, VERTS]
    back = wp.transpose(p.view)
    for i in range(cuts):
        pixel = work.scratch.targets[i]
        x = work.crossings[i]
        drawn = x[3] + work.moved[i]
        keep = data.windows.keep[there + pixel]
        if keep > 0.0 and drawn >= 0.0 and drawn <= 1.0:
            cut = work.scratch.cuts[i]
            across = 2.0 * keep * (drawn - data.windows.mask[shifted + pixel]) * x[2]
            along = -across * x[1]
            steep = (cut[2] & STEEP) != 0
            du = wp.where(steep, across, along) * lens[0]
            dv = wp.where(steep, along, across) * lens[1]
            a = (1.0 - x[0]) * pulled(work.scene.verts[cut[0]], du, dv)
            b = x[0] * pulled(work.scene.verts[cut[1]], du, dv)
            arm = wp.cw_mul(data.things.verts[verts + cut[0]], p.scale)
            total += slope_of(back * a, arm)
            arm = wp.cw_mul(data.things.verts[verts + cut[1]], p.scale)
            total += slope_of(back * b, arm)
    return total


@wp.func
def pane_of(data: KernelInput, work: Workspace, p: Pose, number: int) -> int:
    """Where the masks under a shift, by its number, begin."""
    things = data.things.starts.shape[0] - 1
    return (number * things + p.thing) * work.scene.height * work.scene.width


@wp.func
def add_cuts(data: KernelInput, work: Workspace, p: Pose, cuts: int) -> None:
    """Add what the outline changes to `squares`; what it adds to pixels is kept by cuts only."""
    for i in range(cuts):
        work.moved[i] = work.shift[work.scratch.targets[i]]
    there = p.thing * work.scene.height * work.scene.width
    for i in range(cuts):
        pixel = work.scratch.targets[i]
        shift = work.shift[pixel]
        if shift != 0.0:
            work.shift[pixel] = 0.0
            keep = data.windows.keep[there + pixel]
            for k in range(data.windows.shifts.shape[0]):
                mask = data.windows.mask[pane_of(data, work, p, k) + pixel]
                old = work.crossings[i][3] - mask
                new = wp.clamp(work.crossings[i][3] + shift, 0.0, 1.0) - mask
                more = wp.float64(keep * (new * new - old * old))
                work.squares[k] = work.squares[k] + more
