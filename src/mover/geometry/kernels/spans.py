"""A triangle's runs of pixel centres, row by row.

The order of the operations is that of the reference in torch, and products are not fused with sums,
so that both decide the same for centres on an edge.
"""

import warp as wp

from mover.geometry.camera import NEAR

TINY = 1e-12  # [px], keeps the slope of level edges finite; their rows use its sign only
AWAY = 1e9  # [px], vertices further off would overflow; their triangles are left out
SLACK = 0.01  # [px], far more than the rounding of a cut near the window
FULL = wp.constant(wp.uint32(0x7FFFFFFF))
HALF = wp.constant(wp.uint64(32))


@wp.struct
class Side:
    """An edge of a triangle from its upper to its lower vertex."""

    y: float
    x: float
    x_step: float
    q: float
    q_step: float


@wp.struct
class Triangle:
    """A triangle cut by rows of pixel centres."""

    across: Side  #: from the top to the bottom
    upper: Side  #: from the top to the middle
    lower: Side  #: from the middle to the bottom
    kink: float  #: row of the middle vertex [px]
    first: int  #: first row
    last: int  #: last row; before the first where nothing is drawn


@wp.func
def on_screen(p: wp.vec3, k: wp.vec4) -> wp.vec3:
    """Column, row [px] and inverse depth [1/m] of a point; zeros where it is not drawn."""
    q = 1.0 / wp.max(p[2], NEAR)
    x = p[0] * q * k[0] + k[2]
    y = p[1] * q * k[1] + k[3]
    if p[2] >= NEAR and wp.abs(x) < AWAY and wp.abs(y) < AWAY:
        return wp.vec3(x, y, q)
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def signed_area(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> float:
    """Twice the area [px²]: negative for fronts, positive for backs, 0 if not drawn."""
    if wp.min(a[2], wp.min(b[2], c[2])) == 0.0:
        return 0.0
    return (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])


@wp.func
def side(a: wp.vec3, b: wp.vec3) -> Side:
    """The edge from `a` down to `b`."""
    drop = wp.max(b[1] - a[1], TINY)
    s = Side()
    s.y = a[1]
    s.x = a[0]
    s.x_step = (b[0] - a[0]) / drop
    s.q = a[2]
    s.q_step = (b[2] - a[2]) / drop
    return s


@wp.func
def is_above(a: wp.vec3, b: wp.vec3, i: wp.int64, j: wp.int64) -> bool:
    """Whether vertex i at `a` comes before vertex j at `b` from the top; ties by index."""
    return a[1] < b[1] or (a[1] == b[1] and i < j)


@wp.func
def triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, face: wp.vec3l, box: wp.vec4i) -> Triangle:
    """Sort the vertices from the top and find the rows.

    Most triangles of a body are smaller than a pixel: these are left before anything is set up.
    The box is what is drawn: first row, row after the last, the same of columns.
    """
    t = Triangle()
    t.first = int(wp.max(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])) - 0.5), float(box[0])))
    t.last = int(wp.min(wp.floor(wp.max(a[1], wp.max(b[1], c[1])) - 0.5), float(box[1] - 1)))
    left = wp.ceil(wp.min(a[0], wp.min(b[0], c[0])) - SLACK - 0.5)
    right = wp.floor(wp.max(a[0], wp.max(b[0], c[0])) + SLACK - 0.5)
    if t.first > t.last or wp.max(left, float(box[2])) > wp.min(right, float(box[3] - 1)):
        t.last = t.first - 1
        return t
    ab = is_above(a, b, face[0], face[1])
    bc = is_above(b, c, face[1], face[2])
    ca = is_above(c, a, face[2], face[0])
    top = wp.where(ab, wp.where(ca, c, a), wp.where(bc, b, c))
    low = wp.where(ab, wp.where(bc, c, b), wp.where(ca, a, c))
    mid = wp.where(ab == bc, b, wp.where(ab == ca, a, c))
    t.across = side(top, low)
    t.upper = side(top, mid)
    t.lower = side(mid, low)
    t.kink = mid[1]
    return t


@wp.struct
class PixelRun:
    """What a row cuts out of a triangle."""

    first: int  #: first column
    count: int  #: number of columns
    q: float  #: inverse depth at the first pixel [1/m]
    step: float  #: its change from one pixel to the next [1/m]


@wp.func
def run_of(t: Triangle, row: int, left: int, right: int) -> PixelRun:
    """The pixels of a row that cuts the triangle, from column `left` to before `right`."""
    y = float(row) + 0.5
    other = t.upper
    if y >= t.kink:
        other = t.lower
    x = t.across.x + (y - t.across.y) * t.across.x_step
    x2 = other.x + (y - other.y) * other.x_step
    low = wp.where(x < x2, x, x2) - 0.5
    high = wp.where(x < x2, x2, x) - 0.5
    start = float(left)
    end = float(right)
    r = PixelRun()
    r.first = int(wp.ceil(wp.where(low > start, wp.where(low < end, low, end), start)))
    last = wp.where(high > start - 1.0, wp.where(high < end, high, end - 1.0), start - 1.0)
    r.count = int(wp.floor(last)) - r.first + 1
    if r.count > 0:
        q = t.across.q + (y - t.across.y) * t.across.q_step
        q2 = other.q + (y - other.y) * other.q_step
        span = x2 - x
        r.step = (q2 - q) * span / wp.max(span * span, TINY)
        r.q = q + (float(r.first) + 0.5 - x) * r.step
    return r


@wp.func
def fill(keys: wp.array(dtype=wp.uint64), start: int, r: PixelRun, tag: int) -> None:
    """Raise the keys of a run: where its key is greater than the pixel's it wins.

    The tag is face + 1 where the nearest run wins, less than zero where the farthest does.
    """
    flip = wp.where(tag > 0, wp.uint32(0), FULL)
    face = wp.uint64(wp.abs(tag))
    i = int(0)
    while i < r.count:
        at = r.q + float(i) * r.step
        bits = wp.cast(wp.where(at > TINY, at, TINY), wp.uint32) ^ flip
        wp.atomic_max(keys, start + r.first + i, (wp.uint64(bits) << HALF) | face)
        i += 1
