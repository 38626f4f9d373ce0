"""Silhouettes and depth in plain torch, in any precision: the reference of the kernels.

Triangles become pixels by scan lines. Decisions (which centre lies in which triangle, which surface
is in front) are made in float32. An edge is cut by a row with the same arithmetic for both of its
triangles, so that closed meshes have no cracks; a centre exactly on an edge belongs to both sides.

The outline is made of edges between a front-facing triangle and one that is not. Steep edges are
cut by the rows of pixel centres, flat ones by the columns. A cut counts between a covered and an
uncovered centre, on the covered one's side; of several the outermost does (a dense mesh has many
edges within one pixel).
"""

from dataclasses import dataclass
from math import prod

import torch
from jaxtyping import Float
from torch import Tensor

from mover.geometry.camera import NEAR
from mover.geometry.raster.draw import Crops, Depths, Topology

BORDER = 1  # [px], as in the kernels
TINY = 1e-12  # [px], keeps the slope of level edges finite; their rows use its sign only
AWAY = 1e9  # [px], vertices further off would overflow; their triangles are left out
LOW = 0xFFFFFFFF  # low half of a packed key
LEVEL = 1e-6  # [px], edges shorter than this along their lines have no place to be cut
GRAZING = 0.01  # sine of the angle below which a triangle's depth has no gradient
AGREE = 1e-3  # relative difference of plane and scan line in 1/z beyond which the plane is noise


@dataclass(frozen=True)
class Screen:
    """Vertices of all items on their pixel grids."""

    x: Tensor  # column [px]; the first centre is at 0.5
    y: Tensor  # row [px]
    q: Tensor  # inverse depth [1/m]
    drawn: Tensor  # whether the vertex is in front of the near plane, and finite
    size: tuple[int, int, int]  # items, rows and columns of the grids


@dataclass(frozen=True)
class Spans:
    """Runs of pixel centres inside a triangle, one for each triangle and row."""

    face: Tensor  # triangle, counted over all items
    line: Tensor  # row, counted over all items
    first: Tensor  # first column of the run [px]
    count: Tensor  # number of centres; it may be 0
    q: Tensor  # inverse depth at the first centre [1/m]
    step: Tensor  # its change from one column to the next [1/m]
    nearest: bool  # whether the nearest run wins a pixel, else the farthest


@dataclass(frozen=True)
class Outline:
    """Edges between a triangle that is drawn and faces the camera and one that does not."""

    ends: Tensor  # two vertices, 2 rows, in the order of the lines that cut the edge
    steep: Tensor  # cut by rows, else by columns
    outward: Tensor  # whether the object lies before the edge on those lines: 1, else -1
    item: Tensor  # item that the edge belongs to


@dataclass(frozen=True)
class Cuts:
    """The cuts that count, one for each pair of a covered and an uncovered centre."""

    ends: Tensor  # the edge's two vertices, 2 rows, counted over all items
    steep: Tensor  # cut by a row, else by a column
    item: Tensor  # item that the edge belongs to
    line: Tensor  # that row or column, in its item [px]
    place: Tensor  # the covered centre along that line, in its item [px]
    outward: Tensor  # direction from the covered to the uncovered centre, 1 or -1
    inner: Tensor  # the covered pixel, counted over all items
    outer: Tensor  # the uncovered pixel, counted over all items

    def some(self, index: Tensor) -> "Cuts":
        """Those of an index."""
        return Cuts(*(value.index_select(-1, index) for value in vars(self).values()))


def look(
    verts_cam: Float[Tensor, "*starts items verts 3"],
    shape: Topology,
    views: Crops,
    depth: bool = True,
) -> tuple[Float[Tensor, "*starts items h w"], Depths | None]:
    """See `raster.look`."""
    return _seen(verts_cam, shape, views, True, depth)


def depths(
    verts_cam: Float[Tensor, "*starts items verts 3"], shape: Topology, views: Crops
) -> Depths:
    """See `raster.depths`."""
    return _seen(verts_cam, shape, views, False, True)[1]


def _rows(table: Tensor) -> Tensor:
    """Put the last axis first and join the others."""
    return table.flatten(0, 1).T.contiguous()


def _seen(
    verts_cam: Tensor, shape: Topology, views: Crops, silhouette: bool, depth: bool
) -> tuple[Tensor, Depths | None]:
    """Silhouette and depths of starts x items as one list (zeros where not asked for)."""
    items, n_faces, _ = shape.faces.shape
    verts, size = verts_cam.flatten(0, -3), (*verts_cam.shape[:-2], views.height, views.width)
    image = nearest = farthest = verts_cam.new_zeros(size)
    hit = image.bool()
    if prod(verts.shape[:2]) == 0:
        return image, Depths(nearest, farthest, hit) if depth else None
    place = torch.arange(len(verts), device=verts.device)
    faces = _rows(shape.faces[place % items].long() + (place * verts.shape[1])[:, None, None])
    edges = shape.edges[place % items, : None if n_faces else 0].long()
    counts = torch.tensor([verts.shape[1]] * 2 + [n_faces] * 2, device=verts.device)
    edges = _rows(edges + (place[:, None] * counts)[:, None])
    K = views.K[place % items].to(verts)
    K = K + verts.new_tensor([[0.0, 0, BORDER], [0, 0, BORDER], [0, 0, 0]])
    grid = (len(verts), views.height + 2 * BORDER, views.width + 2 * BORDER)

    def inside(flat: Tensor) -> Tensor:
        return flat.view(grid)[:, BORDER:-BORDER, BORDER:-BORDER].reshape(size)

    screen = on_screen(verts, K, grid[1:])
    area = signed_areas(screen, faces)
    fronts = spans(screen, faces, area < 0)
    if silhouette:
        covered = coverage(screen, fronts)
        found = cuts(screen, outline(screen, faces, edges, area < 0), covered)
        image = inside(blend(verts.reshape(-1, 3), K, found, covered))
    if not depth:
        return image, None
    backs = spans(screen, faces, area > 0, nearest=False)
    near, far = zbuffer(screen, fronts), zbuffer(screen, backs)
    covered = (near > 0) & (far > 0)
    pixel, plane = torch.nonzero(covered)[:, 0], planes(verts, K, faces)
    nearest, farthest = (
        inside(surface(plane, screen, runs, keys, pixel))
        for runs, keys in ((fronts, near), (backs, far))
    )
    return image, Depths(nearest, farthest, inside(covered))


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


def outline(screen: Screen, faces: Tensor, edges: Tensor, front: Tensor) -> Outline:
    """Those of the edges (vertices and triangles, 4 rows) that are outline, and their outside."""
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
    found = found.some(few)
    distance = (at.index_select(0, few) - found.place).abs()
    pair = torch.minimum(found.inner, found.outer) + torch.where(found.steep, 0, last + 1)
    keys = (distance.view(torch.int32).long() << 32) | torch.arange(len(few), device=few.device)
    best = torch.zeros(2 * (last + 1), dtype=torch.int64, device=few.device)
    best.scatter_reduce_(0, pair, keys, "amax")
    return found.some(torch.nonzero(best[pair] == keys)[:, 0])


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
    """Coverage of each pixel (flat), differentiable in the vertices of the cut edges."""
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


def planes(verts_cam: Tensor, K: Tensor, faces: Tensor) -> Tensor:
    r"""Inverse depth of each triangle's plane as a function of the pixel.

    1/z = (n \cdot r) / (n \cdot v) with the viewing ray r of a pixel, the normal n and a vertex v.

    Returns:
        3 rows: change with the column, with the row, value at (0, 0) [1/m]; zeros where the
        triangle is seen edge-on or has no area.
    """
    a, b, c = verts_cam.reshape(-1, 3).index_select(0, faces.reshape(-1)).view(3, -1, 3)
    normal = torch.linalg.cross(b - a, c - a)
    toward = (normal * a).sum(-1)
    limit = GRAZING**2 * normal.square().sum(-1) * a.square().sum(-1)
    keep = (toward.square() > limit) & torch.isfinite(toward)
    normal = normal * (keep / torch.where(keep, toward, 1))[:, None]
    u, v, one = normal.view(len(verts_cam), -1, 3).unbind(-1)
    k = K[:, :, :, None]
    x, y = u / k[:, 0, 0], v / k[:, 1, 1]
    return torch.stack([x, y, one - x * k[:, 0, 2] - y * k[:, 1, 2]]).view(3, -1)


def surface(plane: Tensor, screen: Screen, runs: Spans, keys: Tensor, pixel: Tensor) -> Tensor:
    """Depth [m] of each pixel (flat) by its plane, 0 but for those listed, which have a winner."""
    _, height, width = screen.size
    seen = keys.index_select(0, pixel)
    run = seen & LOW
    line = runs.line.index_select(0, run)
    column = pixel - line * width + 0.5
    row = line % height + 0.5
    face = runs.face.index_select(0, run)
    per_x, per_y, start = (p.index_select(0, face) for p in plane.unbind(0))
    q = per_x * column + per_y * row + start
    scan = inverse_depth(seen, runs.nearest).to(q)
    z = 1 / torch.where((q - scan).abs() < AGREE * scan, q, scan)
    return z.new_zeros(len(keys)).scatter(0, pixel, z)
