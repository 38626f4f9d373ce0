"""Which pixels an item covers, from its outline alone.

The number of fronts on a pixel's ray is the number of times that the outline, the edges between a
front and what is not, is entered on the way from the left. So no triangle is drawn. The edges are
cut by rows as in `spans`.
"""

import warp as wp

from mover.energy.fused.kernels.data import EDGES, FACES, VERTS, KernelInput, Pose, Workspace
from mover.geometry.camera import NEAR
from mover.geometry.kernels.spans import is_above, on_screen, side, signed_area

FRONT, NEITHER, BACK = (wp.constant(wp.int8(k)) for k in (1, 0, -1))
FAR = 1.0e30
SLACK = 3.0  # [px] around an item that its outline may touch
ROUNDING = 1e-6  # share of the largest column by which a cut can be off
BYTE, ALL = wp.constant(wp.uint64(255)), wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))


@wp.struct
class ScreenExtent:
    """Where an item is on the screen."""

    box: wp.vec4i
    """What it may touch: first row, row after the last, the same of columns, in the grid."""
    left: int  #: its leftmost vertex, and so on; the first of equals
    top: int
    right: int
    bottom: int


@wp.func
def put(data: KernelInput, work: Workspace, p: Pose) -> ScreenExtent:
    """Put the vertices before the camera and on the screen."""
    low = wp.vec2(FAR, FAR)
    high = wp.vec2(-FAR, -FAR)
    least = wp.vec2(FAR, FAR)
    most = wp.vec2(-FAR, -FAR)
    e = ScreenExtent()
    lens = data.windows.lens[p.thing]
    work.scene.window[0] = lens
    first = data.things.starts[p.thing, VERTS]
    for v in range(data.things.starts[p.thing + 1, VERTS] - first):
        at = p.view * wp.cw_mul(data.things.verts[first + v], p.scale) + p.origin
        work.scene.verts[v] = at
        s = on_screen(at, lens)
        work.scratch.screen[v] = s
        if s[2] > 0.0:
            low = wp.min(low, wp.vec2(s[0], s[1]))
            high = wp.max(high, wp.vec2(s[0], s[1]))
        q = 1.0 / wp.max(at[2], NEAR)
        uv = wp.vec2(at[0] * q, at[1] * q)
        e.left = wp.where(uv[0] < least[0], v, e.left)
        e.top = wp.where(uv[1] < least[1], v, e.top)
        e.right = wp.where(uv[0] > most[0], v, e.right)
        e.bottom = wp.where(uv[1] > most[1], v, e.bottom)
        least = wp.min(least, uv)
        most = wp.max(most, uv)
    height = float(work.scene.height)
    width = float(work.scene.width)
    slack = SLACK + ROUNDING * wp.max(wp.abs(low[0]), wp.abs(high[0]))
    e.box = wp.vec4i(
        int(wp.clamp(low[1] - SLACK, 0.0, height)),
        int(wp.clamp(high[1] + SLACK, 0.0, height)),
        int(wp.clamp(low[0] - slack, 0.0, width)),
        int(wp.clamp(high[0] + slack, 0.0, width)),
    )
    return e


@wp.func
def face_all(data: KernelInput, work: Workspace, p: Pose) -> int:
    """Tell fronts from backs; the number of faces that are neither."""
    neither = int(0)
    first = data.things.starts[p.thing, FACES]
    for f in range(data.things.starts[p.thing + 1, FACES] - first):
        face = data.things.faces[first + f]
        area = signed_area(
            work.scratch.screen[face[0]], work.scratch.screen[face[1]], work.scratch.screen[face[2]]
        )
        work.scratch.front[f] = wp.where(area < 0.0, FRONT, wp.where(area > 0.0, BACK, NEITHER))
        neither += wp.where(area == 0.0, 1, 0)
    return neither


@wp.func
def wall(work: Workspace, i: int, j: int) -> None:
    """Let the layers change where rows cross the edge of a front that runs from i to j.

    Seen from outside a front turns to the left, so that it lies to the right of a falling edge.
    """
    a = work.scratch.screen[i]
    b = work.scratch.screen[j]
    falls = is_above(a, b, wp.int64(i), wp.int64(j))
    s = side(wp.where(falls, a, b), wp.where(falls, b, a))
    width = work.scene.width
    row = int(wp.max(wp.ceil(s.y - 0.5), 0.0))
    stop = int(wp.min(wp.ceil(wp.max(a[1], b[1]) - 0.5), float(work.scene.height)))
    change = wp.where(falls, wp.uint8(1), wp.uint8(255))
    while row < stop:
        x = s.x + (float(row) + 0.5 - s.y) * s.x_step - 0.5
        column = int(0)
        if falls:
            column = int(wp.ceil(wp.clamp(x, 0.0, float(width))))
        else:
            column = int(wp.floor(wp.clamp(x, -1.0, float(width - 1)))) + 1
        at = row * work.stride + column
        work.steps[at] = work.steps[at] + change
        row += 1


@wp.func
def walls(data: KernelInput, work: Workspace, p: Pose, side: wp.int8) -> int:
    """Enter the outline of the fronts, or of the backs; the number of its edges, in `queue`."""
    n = int(0)
    first = data.things.starts[p.thing, EDGES]
    for e in range(data.things.starts[p.thing + 1, EDGES] - first):
        edge = data.things.edges[first + e]
        one = work.scratch.front[edge[2]] == side
        if one != (work.scratch.front[edge[3]] == side):
            if one == (side == FRONT):
                wall(work, edge[0], edge[1])
            else:
                wall(work, edge[1], edge[0])
            work.scratch.queue[n] = first + e
            n += 1
    return n


@wp.func
def flood(
    data: KernelInput, work: Workspace, p: Pose, box: wp.vec4i, bits: wp.array(dtype=wp.uint64)
) -> None:
    """Mark what the outline encloses, and take it down; add what that changes to `squares`.

    Layers are counted modulo 256, so that a step needs one byte. Bits, one for each pixel, are set.
    """
    pane = work.scene.height * (work.scene.width + 1)
    for row in range(box[0], box[1]):
        layers = int(0)
        begin = int(0)
        start = p.thing * pane + row * (work.scene.width + 1)
        for k in range(box[2] >> 3, (box[3] >> 3) + 1):
            eight = row * (work.stride >> 3) + k
            word = work.words[eight]
            if word != wp.uint64(0):
                work.words[eight] = wp.uint64(0)
                for j in range(8):
                    change = int((word >> wp.uint64(8 * j)) & BYTE)
                    if change != 0:
                        after = (layers + change) & 255
                        column = 8 * k + j
                        if layers == 0:
                            begin = column
                        if after == 0:
                            mark(bits, row * work.across, begin, column)
                            add(data, work, start + begin, start + column)
                        layers = after


@wp.func
def add(data: KernelInput, work: Workspace, begin: int, end: int) -> None:
    """Add what covering a run of pixels changes, under each shift."""
    things = data.things.starts.shape[0] - 1
    all_panes = things * work.scene.height * (work.scene.width + 1)
    for i in range(data.windows.shifts.shape[0]):
        gained = data.windows.gain[i * all_panes + end] - data.windows.gain[i * all_panes + begin]
        work.squares[i] = work.squares[i] + gained


@wp.func
def mark(bits: wp.array(dtype=wp.uint64), start: int, begin: int, end: int) -> None:
    """Set the bits from `begin` to before `end` in the words of a row."""
    for k in range(begin >> 6, ((end - 1) >> 6) + 1):
        low = wp.max(begin - 64 * k, 0)
        high = wp.min(end - 64 * k, 64)
        ones = (ALL >> wp.uint64(64 - (high - low))) << wp.uint64(low)
        bits[start + k] = bits[start + k] | ones


@wp.func
def is_marked(work: Workspace, bits: wp.array(dtype=wp.uint64), row: int, column: int) -> bool:
    """Whether the bit of a pixel is set."""
    word = bits[row * work.across + (column >> 6)]
    return ((word >> wp.uint64(column & 63)) & wp.uint64(1)) != wp.uint64(0)


@wp.func
def clear(work: Workspace, bits: wp.array(dtype=wp.uint64), box: wp.vec4i) -> None:
    """Leave no marks."""
    for row in range(box[0], box[1]):
        for k in range(box[2] >> 6, ((box[3] - 1) >> 6) + 1):
            bits[row * work.across + k] = wp.uint64(0)
