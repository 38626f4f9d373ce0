# pyright: basic, reportInvalidTypeForm=false
"""The price of a silhouette (`terms.silhouette`) and its gradient, from the outline alone.

The pixels that the outline moves are counted anew; of the others only those that are covered.
"""

from typing import no_type_check

import warp as wp

from .contour import STEEP, Contour, Gap, contour, crossing, cut_of, gap, key, pulled
from .cover import FRONT, is_marked
from .given import FACES, VERTS, Desk, Given, Pose, Slope, slope_of


@wp.func
@no_type_check
def edge_of_outline(given: Given, desk: Desk, p: Pose, e: int) -> Contour:
    """An edge between a front and what is none."""
    edge = given.things.edges[e]
    front = wp.where(desk.scratch.front[edge[2]] == FRONT, edge[2], edge[3])
    face = given.things.faces[given.things.starts[p.thing, FACES] + front]
    wide = wp.vec4l(wp.int64(edge[0]), wp.int64(edge[1]), wp.int64(edge[2]), wp.int64(edge[3]))
    corners = wp.vec3l(wp.int64(face[0]), wp.int64(face[1]), wp.int64(face[2]))
    return contour(desk.scene, desk.scratch, 0, wide, corners)


@wp.func
@no_type_check
def enter(given: Given, desk: Desk, p: Pose, edges: int) -> int:
    """List the cuts of pairs of a covered and an uncovered centre; their number.

    Of each pair, the outermost is remembered.
    """
    n = int(0)
    for i in range(edges):
        e = desk.scratch.queue[i]
        c = edge_of_outline(given, desk, p, e)
        for line in range(c.first, c.last + 1):
            g = gap(desk.scene, c, line)
            if g.distance >= 0.0 and parts(desk, c, g, line) and n < desk.pairs.shape[0]:
                k = key(g, e)
                desk.scratch.cuts[n] = cut_of(desk.scene, 0, c, g, line)
                desk.pairs[n] = g.pair
                desk.keys[n] = k
                n += 1
                if k > desk.scratch.pairs[g.pair]:
                    desk.scratch.pairs[g.pair] = k
    return n


@wp.func
@no_type_check
def parts(desk: Desk, c: Contour, g: Gap, line: int) -> bool:
    """Whether the inner centre is covered and the outer one is not."""
    beyond = g.place + c.outward
    if c.steep:
        inner = is_marked(desk, desk.seen, line, g.place)
        return inner and not is_marked(desk, desk.seen, line, beyond)
    inner = is_marked(desk, desk.seen, g.place, line)
    return inner and not is_marked(desk, desk.seen, beyond, line)


@wp.func
@no_type_check
def list_cuts(desk: Desk, found: int) -> int:
    """Keep the cuts that count, and add up what they change; their number."""
    n = int(0)
    for i in range(found):
        pair = desk.pairs[i]
        if desk.scratch.pairs[pair] == desk.keys[i]:
            desk.scratch.pairs[pair] = wp.uint64(0)
            cut = desk.scratch.cuts[i]
            x = crossing(desk.scene, cut)
            if x.target >= 0:
                target = on_grid(desk, x.target)
                covered = wp.where(x.shift < 0.0, 1.0, 0.0)
                desk.scratch.cuts[n] = cut
                desk.scratch.targets[n] = target
                desk.crossings[n] = wp.vec4(x.share, x.slope, x.outward, covered)
                desk.shift[target] = desk.shift[target] + x.shift
                n += 1
    return n


@wp.func
@no_type_check
def on_grid(desk: Desk, pixel: int) -> int:
    """The pixel of the grid for one of the window."""
    border = desk.scene.border
    wide = desk.scene.width - 2 * border
    return (pixel / wide + border) * desk.scene.width + pixel % wide + border


@wp.func
@no_type_check
def pull_cuts(given: Given, desk: Desk, p: Pose, cuts: int, number: int) -> Slope:
    """Change of the sum of squares under a shift, by its number, with the pose."""
    total = Slope()
    lens = desk.scene.window[0]
    there = p.thing * desk.scene.height * desk.scene.width
    shifted = pane_of(given, desk, p, number)
    verts = given.things.starts[p.thing, VERTS]
    back = wp.transpose(p.view)
    for i in range(cuts):
        pixel = desk.scratch.targets[i]
        x = desk.crossings[i]
        drawn = x[3] + desk.moved[i]
        keep = given.windows.keep[there + pixel]
        if keep > 0.0 and drawn >= 0.0 and drawn <= 1.0:
            cut = desk.scratch.cuts[i]
            across = 2.0 * keep * (drawn - given.windows.mask[shifted + pixel]) * x[2]
            along = -across * x[1]
            steep = (cut[2] & STEEP) != 0
            du = wp.where(steep, across, along) * lens[0]
            dv = wp.where(steep, along, across) * lens[1]
            a = (1.0 - x[0]) * pulled(desk.scene.verts[cut[0]], du, dv)
            b = x[0] * pulled(desk.scene.verts[cut[1]], du, dv)
            arm = wp.cw_mul(given.things.verts[verts + cut[0]], p.scale)
            total += slope_of(back * a, arm)
            arm = wp.cw_mul(given.things.verts[verts + cut[1]], p.scale)
            total += slope_of(back * b, arm)
    return total


@wp.func
@no_type_check
def pane_of(given: Given, desk: Desk, p: Pose, number: int) -> int:
    """Where the masks under a shift, by its number, begin."""
    things = given.things.starts.shape[0] - 1
    return (number * things + p.thing) * desk.scene.height * desk.scene.width


@wp.func
@no_type_check
def price_cuts(given: Given, desk: Desk, p: Pose, cuts: int) -> None:
    """Add what the outline changes to `squares`; what it adds to pixels is kept by cuts only."""
    for i in range(cuts):
        desk.moved[i] = desk.shift[desk.scratch.targets[i]]
    there = p.thing * desk.scene.height * desk.scene.width
    for i in range(cuts):
        pixel = desk.scratch.targets[i]
        shift = desk.shift[pixel]
        if shift != 0.0:
            desk.shift[pixel] = 0.0
            keep = given.windows.keep[there + pixel]
            for k in range(given.windows.shifts.shape[0]):
                mask = given.windows.mask[pane_of(given, desk, p, k) + pixel]
                old = desk.crossings[i][3] - mask
                new = wp.clamp(desk.crossings[i][3] + shift, 0.0, 1.0) - mask
                more = wp.float64(keep * (new * new - old * old))
                desk.squares[k] = desk.squares[k] + more
