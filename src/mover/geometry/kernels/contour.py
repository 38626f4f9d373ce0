"""Where the outline of an item passes between pixel centres."""

import warp as wp

from mover.geometry.kernels.scene import Items, Scratch
from mover.geometry.kernels.spans import HALF, TINY

LEVEL = 1e-6  # [px], edges shorter than this along their lines have no place to be cut
STEEP, OUTWARD = 2, 1  # flags of a cut


@wp.struct
class Contour:
    """An edge of the outline and the lines of pixel centres that cut it."""

    v0: int  #: its vertices, in the order of the lines, in the item
    v1: int
    low: float  #: where the lines begin and what a line adds [px]
    at: float
    slope: float
    steep: bool  #: cut by rows, else by columns
    outward: int
    """Whether the object lies before the edge on those lines: 1, else -1; 0: no object."""
    first: int  #: first line
    last: int  #: last line


@wp.struct
class Gap:
    """A covered and an uncovered centre with a cut in between."""

    inner: int  #: pixels in the item
    outer: int
    pair: int  #: its entry in `pairs` of the item
    place: int  #: the covered centre along the line [px]
    distance: float  #: from the covered centre to the cut [px]; negative where there is none


@wp.func
def contour(scene: Items, scratch: Scratch, edge: wp.vec4l, face: wp.vec3l) -> Contour:
    """An edge between `face`, which is drawn and faces the camera, and one that does not."""
    c = Contour()
    i = int(edge[0])
    j = int(edge[1])
    k = int(face[0] + face[1] + face[2] - edge[0] - edge[1])
    a = scratch.screen[i]
    b = scratch.screen[j]
    third = scratch.screen[k]
    normal_x = b[1] - a[1]
    normal_y = a[0] - b[0]
    inside = (third[0] - a[0]) * normal_x + (third[1] - a[1]) * normal_y
    c.steep = wp.abs(normal_x) >= wp.abs(normal_y)
    c.outward = -sign(inside) * sign(wp.where(c.steep, normal_x, normal_y))
    flip = wp.where(c.steep, a[1] > b[1], a[0] > b[0])
    c.v0 = wp.where(flip, j, i)
    c.v1 = wp.where(flip, i, j)
    p = wp.where(flip, b, a)
    n = wp.where(flip, a, b)
    c.low = wp.where(c.steep, p[1], p[0])
    c.at = wp.where(c.steep, p[0], p[1])
    span = wp.where(c.steep, n[1], n[0]) - c.low
    size = wp.where(c.steep, scene.height, scene.width)
    c.slope = (wp.where(c.steep, n[0], n[1]) - c.at) / wp.max(span, TINY)
    c.first = int(wp.max(wp.ceil(c.low - 0.5), 0.0))
    c.last = int(wp.min(wp.floor(wp.where(c.steep, n[1], n[0]) - 0.5), float(size - 1)))
    if span <= LEVEL or c.outward == 0:
        c.last = c.first - 1
    return c


@wp.func
def sign(x: float) -> int:
    """1, 0 or -1."""
    return wp.where(x > 0.0, 1, wp.where(x < 0.0, -1, 0))


@wp.func
def gap(scene: Items, c: Contour, line: int) -> Gap:
    """The two centres between which a line is cut, whatever they cover."""
    g = Gap()
    at = c.at + (float(line) + 0.5 - c.low) * c.slope - 0.5
    at = wp.clamp(at, -2.0, float(wp.max(scene.height, scene.width) + 1))
    g.place = int(wp.where(c.outward > 0, wp.floor(at), wp.ceil(at)))
    size = wp.where(c.steep, scene.width, scene.height)
    start = line * wp.where(c.steep, scene.width, 1)
    stride = wp.where(c.steep, 1, scene.width)
    beyond = g.place + c.outward
    g.inner = start + g.place * stride
    g.outer = start + beyond * stride
    g.pair = wp.min(g.inner, g.outer) + wp.where(c.steep, 0, scene.height * scene.width)
    g.distance = wp.abs(at - float(g.place))
    if g.place < 0 or g.place >= size or beyond < 0 or beyond >= size:
        g.distance = -1.0
    return g


@wp.func
def key(g: Gap, edge: int) -> wp.uint64:
    """Orders the cuts of one pair: the outermost wins, then the later edge."""
    return (wp.uint64(wp.cast(g.distance, wp.uint32)) << HALF) | wp.uint64(edge + 1)


@wp.func
def cut_of(scene: Items, item: int, c: Contour, g: Gap, line: int) -> wp.vec4i:
    """What is kept of a cut."""
    flags = wp.where(c.steep, STEEP, 0) + wp.where(c.outward > 0, OUTWARD, 0)
    base = item * scene.n_verts
    return wp.vec4i(base + c.v0, base + c.v1, line * 4 + flags, g.place)


@wp.struct
class Crossing:
    """A cut, computed again from the vertices."""

    target: int  #: pixel of the window that the cut moves, over all items; -1: it is in the border
    shift: float  #: what the cut adds to it
    share: float  #: where it cuts the edge, from its first vertex (0) to its second (1)
    slope: float  #: its motion along the line for that of the edge's line [px/px]
    outward: float
    steep: bool


@wp.func
def crossing(scene: Items, cut: wp.vec4i) -> Crossing:
    """Where a cut is, and which pixel it moves."""
    x = Crossing()
    item = cut[0] / scene.n_verts
    k = scene.window[item % scene.views]
    a = scene.verts[cut[0]]
    b = scene.verts[cut[1]]
    line = cut[2] >> 2
    x.steep = (cut[2] & STEEP) != 0
    outward = wp.where((cut[2] & OUTWARD) != 0, 1, -1)
    x.outward = float(outward)
    ax = a[0] / a[2] * k[0] + k[2]
    ay = a[1] / a[2] * k[1] + k[3]
    bx = b[0] / b[2] * k[0] + k[2]
    by = b[1] / b[2] * k[1] + k[3]
    low = wp.where(x.steep, ay, ax)
    across = wp.where(x.steep, ax, ay)
    span = wp.where(x.steep, by, bx) - low
    run = wp.where(x.steep, bx, by) - across
    x.share = (float(line) + 0.5 - low) / span
    x.slope = run / span
    distance = (across + x.share * run - 0.5 - float(cut[3])) * x.outward
    x.shift = distance - 0.5
    place = cut[3] + wp.where(distance < 0.5, 0, outward)
    row = wp.where(x.steep, line, place) - scene.border
    column = wp.where(x.steep, place, line) - scene.border
    height = scene.height - 2 * scene.border
    width = scene.width - 2 * scene.border
    x.target = (item * height + row) * width + column
    if row < 0 or column < 0 or row >= height or column >= width:
        x.target = -1
    return x


@wp.func
def pull_cut(scene: Items, cut: wp.vec4i, gradient: float, grads: wp.array(dtype=wp.vec3)) -> None:
    """Add the gradient of a cut's pixel to the two vertices of its edge."""
    x = crossing(scene, cut)
    k = scene.window[cut[0] / scene.n_verts % scene.views]
    across = gradient * x.outward
    along = -across * x.slope
    du = wp.where(x.steep, across, along) * k[0]
    dv = wp.where(x.steep, along, across) * k[1]
    wp.atomic_add(grads, cut[0], (1.0 - x.share) * pulled(scene.verts[cut[0]], du, dv))
    wp.atomic_add(grads, cut[1], x.share * pulled(scene.verts[cut[1]], du, dv))


@wp.func
def pulled(p: wp.vec3, du: float, dv: float) -> wp.vec3:
    """Gradient of a point from that of its image, in focal lengths."""
    return wp.vec3(du, dv, -(du * p[0] + dv * p[1]) / p[2]) / p[2]
