"""Where the outline of a drawn object passes between pixel centres.

The outline is made of edges between a front-facing triangle and one that is not. Steep edges are
cut by the rows of pixel centres, flat ones by the columns. A cut counts between a covered and an
uncovered centre, on the covered one's side; of several the outermost does (a dense mesh has many
edges within one pixel).
"""

from dataclasses import dataclass

import torch
from raster_torch_spans import TINY, Screen, ragged
from torch import Tensor

LEVEL = 1e-6  # [px], edges shorter than this along their lines have no place to be cut


@dataclass(frozen=True)
class Cuts:
    """The cuts that count, one for each pair of a covered and an uncovered centre."""

    ends: Tensor
    """The edge's two vertices, 2 rows, counted over all items."""
    steep: Tensor
    """Cut by a row, else by a column."""
    item: Tensor
    """Item that the edge belongs to."""
    line: Tensor
    """That row or column, in its item [px]."""
    place: Tensor
    """The covered centre along that line, in its item [px]."""
    outward: Tensor
    """Direction from the covered to the uncovered centre, 1 or -1."""
    inner: Tensor
    """The covered pixel, counted over all items."""
    outer: Tensor
    """The uncovered pixel, counted over all items."""


@dataclass(frozen=True)
class Outline:
    """Edges between a triangle that is drawn and faces the camera and one that does not."""

    ends: Tensor
    """Two vertices, 2 rows, in the order of the lines that cut the edge."""
    steep: Tensor
    """Cut by rows, else by columns."""
    outward: Tensor
    """Whether the object lies before the edge on those lines: 1, else -1."""
    item: Tensor
    """Item that the edge belongs to."""


def outline(screen: Screen, faces: Tensor, edges: Tensor, front: Tensor) -> Outline:
    """The outline's edges, and where it has its outside.

    Args:
        screen: Projected vertices of all items.
        faces: Vertices of all triangles, 3 rows.
        edges: Vertices and triangles of all edges, 4 rows.
        front: Whether a triangle is drawn and faces the camera.
    """
    first, second = front.index_select(0, edges[2]), front.index_select(0, edges[3])
    on = torch.nonzero(first != second)[:, 0]
    ends, beside = edges[:2].index_select(1, on), edges[2:].index_select(1, on)
    face = torch.where(first.index_select(0, on), beside[0], beside[1])
    third = faces.index_select(1, face).sum(0) - ends.sum(0)
    x, y = screen.x[ends], screen.y[ends]
    normal_x, normal_y = y[1] - y[0], x[0] - x[1]
    inside = (screen.x[third] - x[0]) * normal_x + (screen.y[third] - y[0]) * normal_y
    steep = normal_x.abs() >= normal_y.abs()
    outward = -torch.sign(inside) * torch.sign(torch.where(steep, normal_x, normal_y))
    ends = torch.where(torch.where(steep, y[0] > y[1], x[0] > x[1]), ends.flip(0), ends)
    item = torch.div(face, max(faces.shape[1] // screen.size[0], 1), rounding_mode="floor")
    return Outline(ends, steep, outward, item)


def cuts(screen: Screen, line: Outline, covered: Tensor) -> Cuts:
    """The cuts of the outline that count, given which centres are covered (flat)."""
    items, height, width = screen.size
    found, at = _candidates(screen, line)
    size = torch.where(found.steep, width, height)
    last = items * height * width - 1
    within = (found.place >= 0) & (found.place < size)
    within &= (found.place + found.outward >= 0) & (found.place + found.outward < size)
    hit = covered[found.inner.clamp(0, last)] & ~covered[found.outer.clamp(0, last)]
    few = torch.nonzero(within & hit & (found.outward != 0))[:, 0]
    found = Cuts(**{name: value.index_select(-1, few) for name, value in vars(found).items()})
    distance = (at.index_select(0, few) - found.place).abs()
    pair = torch.minimum(found.inner, found.outer) + torch.where(found.steep, 0, last + 1)
    keys = (distance.view(torch.int32).long() << 32) | torch.arange(len(few), device=few.device)
    best = torch.zeros(2 * (last + 1), dtype=torch.int64, device=few.device)
    best.scatter_reduce_(0, pair, keys, "amax")
    outermost = torch.nonzero(best[pair] == keys)[:, 0]
    return Cuts(**{name: value.index_select(-1, outermost) for name, value in vars(found).items()})


def _candidates(screen: Screen, line: Outline) -> tuple[Cuts, Tensor]:
    """All cuts of edges and lines, and their place along the line in units of centres."""
    _, height, width = screen.size
    x, y = screen.x[line.ends], screen.y[line.ends]
    along, across = torch.where(line.steep, y, x), torch.where(line.steep, x, y)
    span = along[1] - along[0]
    start = (along[0] - 0.5).ceil_().clamp_min_(0)
    stop = torch.minimum((along[1] - 0.5).floor_(), torch.where(line.steep, height - 1, width - 1))
    owner, offset = ragged(((stop - start + 1).clamp_min_(0) * (span > LEVEL)).long())
    slope = (across[1] - across[0]) / span.clamp_min_(TINY)
    at, low, slope, start = (v.index_select(0, owner) for v in (across[0], along[0], slope, start))
    steep, outward, item = (v.index_select(0, owner) for v in (line.steep, line.outward, line.item))
    number = start + offset
    at = at + (number + 0.5 - low) * slope - 0.5
    at = at.clamp_(-2, max(height, width) + 1)
    place = torch.where(outward > 0, at.floor(), at.ceil()).long()
    number, outward = number.long(), outward.long()
    base = item * (height * width) + number * torch.where(steep, width, 1)
    stride = torch.where(steep, 1, width)
    inner, outer = base + place * stride, base + (place + outward) * stride
    ends = line.ends.index_select(1, owner)
    return Cuts(ends, steep, item, number, place, outward, inner, outer), at


def blend(verts_cam: Tensor, K: Tensor, found: Cuts, covered: Tensor) -> Tensor:
    """Coverage of each pixel (flat), differentiable in the vertices of the cut edges.

    Args:
        verts_cam: Vertices of all items, in rows [m].
        K: Intrinsics of each item, for the grid of `covered` [px].
        found: The cuts that count.
        covered: Whether a pixel centre is covered, flat over items, rows, columns.
    """
    ends = verts_cam.index_select(0, found.ends.reshape(-1)).view(2, -1, 3)
    k = K.index_select(0, found.item)
    x = ends[..., 0] / ends[..., 2] * k[:, 0, 0] + k[:, 0, 2]
    y = ends[..., 1] / ends[..., 2] * k[:, 1, 1] + k[:, 1, 2]
    along, across = torch.where(found.steep, y, x), torch.where(found.steep, x, y)
    share = (found.line + 0.5 - along[0]) / (along[1] - along[0])
    at = across[0] + share * (across[1] - across[0]) - 0.5
    distance = (at - found.place) * found.outward
    target = torch.where(distance < 0.5, found.inner, found.outer)
    return covered.to(distance).index_add(0, target, distance - 0.5).clamp(0, 1)
