"""Triangles to pixels by scan lines, for many meshes at once, in plain torch and without gradient.

Decisions (which centre lies in which triangle, which surface is in front) are made in float32.
An edge is cut by a row with the same arithmetic for both of its triangles, so that closed meshes
have no cracks; a centre exactly on an edge belongs to both sides.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from mover.geometry.camera import NEAR

TINY = 1e-12  # [px], keeps the slope of level edges finite; their rows use its sign only
AWAY = 1e9  # [px], vertices further off would overflow; their triangles are left out
LOW = 0xFFFFFFFF  # low half of a packed key


@dataclass(frozen=True)
class Screen:
    """Vertices of all items on their pixel grids."""

    x: Tensor
    """Column [px]; the first centre is at 0.5."""
    y: Tensor
    """Row [px]."""
    q: Tensor
    """Inverse depth [1/m]."""
    drawn: Tensor
    """Whether the vertex is in front of the near plane, and finite."""
    size: tuple[int, int, int]
    """Items, rows and columns of the grids."""


@dataclass(frozen=True)
class Spans:
    """Runs of pixel centres inside a triangle, one for each triangle and row."""

    face: Tensor
    """Triangle, counted over all items."""
    line: Tensor
    """Row, counted over all items."""
    first: Tensor
    """First column of the run [px]."""
    count: Tensor
    """Number of centres; it may be 0."""
    q: Tensor
    """Inverse depth at the first centre [1/m]."""
    step: Tensor
    """Its change from one column to the next [1/m]."""
    nearest: bool
    """Whether the nearest run wins a pixel, else the farthest."""


def ragged(count: Tensor) -> tuple[Tensor, Tensor]:
    """Owner and place within the owner for `count` copies of each index."""
    ends = count.cumsum(0)  # the size of what follows depends on data: this waits for the device
    total = int(ends[-1]) if len(ends) else 0
    starts = torch.zeros(total + 1, dtype=torch.int64, device=count.device)
    starts.scatter_add_(0, ends[:-1], torch.ones_like(ends[:-1]))
    owner = starts[:-1].cumsum(0)
    offset = torch.arange(total, device=count.device) - (ends - count).index_select(0, owner)
    return owner, offset


def on_screen(verts_cam: Tensor, K: Tensor, size: tuple[int, int]) -> Screen:
    """Project the vertices of each item on its grid of `size` rows and columns."""
    points = verts_cam.detach().float()
    k = K.detach().float()[:, :, :, None]
    q = 1 / points[..., 2].clamp_min(NEAR)
    x = points[..., 0] * q * k[:, 0, 0] + k[:, 0, 2]
    y = points[..., 1] * q * k[:, 1, 1] + k[:, 1, 2]
    drawn = (points[..., 2] >= NEAR) & (x.abs() < AWAY) & (y.abs() < AWAY)
    x, y, q, drawn = (v.reshape(-1) for v in (x, y, q, drawn))
    return Screen(x, y, q, drawn, (len(points), *size))


def signed_areas(screen: Screen, faces: Tensor) -> Tensor:
    """Twice each triangle's area [px²]: negative for fronts, positive for backs, 0 if not drawn."""
    x, y = (s.index_select(0, faces.reshape(-1)).reshape(3, -1) for s in (screen.x, screen.y))
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    drawn = screen.drawn.index_select(0, faces.reshape(-1)).reshape(3, -1)
    return area.masked_fill_(~(drawn[0] & drawn[1] & drawn[2]), 0)


def _by_height(screen: Screen, faces: Tensor) -> Tensor:
    """Vertices of each triangle from the top of the image to the bottom, ties by index."""
    bits = screen.y.view(torch.int32)
    bits = bits ^ ((bits >> 31) & 0x7FFFFFFF)
    vertex = torch.arange(len(bits), device=bits.device)
    keys = ((bits.long() << 32) | vertex).index_select(0, faces.reshape(-1)).reshape(3, -1)
    low, high = keys.amin(0), keys.amax(0)
    return torch.stack([low, keys.sum(0) - low - high, high]) & LOW


def _edges(order: Tensor, screen: Screen) -> Tensor:
    """Place, inverse depth and their change with the row, on each edge from its upper vertex.

    Returns 5 rows (y, x, x for each row, 1/z, 1/z for each row) of the edges top-bottom,
    top-middle and middle-bottom of all triangles.
    """
    channels = (screen.y, screen.x, screen.q)
    y, x, q = (s.index_select(0, order.reshape(-1)).reshape(3, -1) for s in channels)
    upper, lower = [0, 0, 1], [2, 1, 2]
    drop = (y[lower] - y[upper]).clamp_min_(TINY)
    x_step, q_step = (x[lower] - x[upper]) / drop, (q[lower] - q[upper]) / drop
    return torch.stack([y[upper], x[upper], x_step, q[upper], q_step]).reshape(5, -1)


def _cut(edges: Tensor, index: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Column [px] and inverse depth [1/m] where rows at `y` cut the edges."""
    y_up, x, x_step, q, q_step = (e.index_select(0, index) for e in edges)
    down = y - y_up
    return x + down * x_step, q + down * q_step


def spans(screen: Screen, faces: Tensor, drawn: Tensor, nearest: bool = True) -> Spans:
    """Runs of pixels of the triangles that are `drawn`, of `faces` (3 rows, over all items)."""
    chosen = torch.nonzero(drawn)[:, 0]
    items, height, width = screen.size
    per_item = faces.shape[1] // items
    order = _by_height(screen, faces.index_select(1, chosen))
    top = (screen.y.index_select(0, order[0]) - 0.5).ceil_().clamp_min_(0)
    bottom = (screen.y.index_select(0, order[2]) - 0.5).floor_().clamp_max_(height - 1)
    few = torch.nonzero(bottom >= top)[:, 0]
    order, chosen, top, bottom = (v.index_select(-1, few) for v in (order, chosen, top, bottom))
    owner, offset = ragged((bottom - top + 1).long())
    row = top.index_select(0, owner) + offset
    edges = _edges(order, screen)
    kink = screen.y.index_select(0, order[1]).index_select(0, owner)
    x, q = _cut(edges, owner, row + 0.5)
    x2, q2 = _cut(edges, owner + len(few) * (1 + (row + 0.5 >= kink).long()), row + 0.5)
    first = (torch.minimum(x, x2) - 0.5).ceil_().clamp_(0, width)
    last = (torch.maximum(x, x2) - 0.5).floor_().clamp_(-1, width - 1)
    across = x2 - x
    step = (q2 - q) * across / across.square().clamp_min_(TINY)
    item = torch.div(chosen, max(per_item, 1), rounding_mode="floor")
    line = (item * height).index_select(0, owner) + row.long()
    count = (last - first + 1).clamp_min_(0).long()
    q = q + (first + 0.5 - x) * step
    return Spans(chosen.index_select(0, owner), line, first.long(), count, q, step, nearest)


def coverage(screen: Screen, runs: Spans) -> Tensor:
    """Whether each pixel centre (flat over items, rows, columns) is in a run."""
    items, height, width = screen.size
    wide = width + 1
    start = runs.line * wide + runs.first
    changes = torch.zeros(items * height * wide, dtype=torch.int32, device=screen.x.device)
    one = torch.ones_like(start, dtype=torch.int32)
    changes.scatter_add_(0, start, one).scatter_add_(0, start + runs.count, -one)
    inside = changes.cumsum(0, dtype=torch.int32).view(items, height, wide) > 0
    return inside[..., :-1].reshape(-1)


def zbuffer(screen: Screen, runs: Spans) -> Tensor:
    """Winner of each pixel: inverse depth (float bits, high half) and run (low half); 0 is none.

    Where the farthest wins, the float bits are complemented.
    """
    items, height, width = screen.size
    owner, offset = ragged(runs.count)
    q = runs.q.index_select(0, owner) + offset * runs.step.index_select(0, owner)
    keys = q.clamp_min_(TINY).view(torch.int32).long()
    keys = ((keys if runs.nearest else 0x7FFFFFFF - keys) << 32) | owner
    pixel = (runs.line * width + runs.first).index_select(0, owner) + offset
    buffer = torch.zeros(items * height * width, dtype=torch.int64, device=screen.x.device)
    return buffer.scatter_reduce_(0, pixel, keys, "amax")


def inverse_depth(keys: Tensor, nearest: bool = True) -> Tensor:
    """Inverse depth [1/m] out of the keys of `zbuffer`, as float32."""
    bits = keys >> 32
    return (bits if nearest else 0x7FFFFFFF - bits).int().view(torch.float32)
