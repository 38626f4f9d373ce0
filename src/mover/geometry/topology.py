"""Closed parts of a mesh as one solid, without resampling."""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from mover.geometry.nearest import as_int64

THIN = 1e-6  # [cube of the longest side], a part with less volume is a sheet, not a solid
SHEET_SHARE = 0.01  # of all surface; sheets of less are flaws and go
FLAT = 1e-3  # [longest side], a hole is flat if its rim is within this
CAP_SHARE = 0.05  # of all surface; a flat hole of more is an opening, one of less a flaw

Triangles = tuple[np.ndarray, np.ndarray]


def solid(verts: np.ndarray, faces: np.ndarray) -> Triangles | None:
    """The mesh as one outward-wound solid; None if a part of it is open or a sheet.

    Parts that lie inside others, whichever way they are wound, disappear in the union.
    """
    tails, heads = half_edges(faces)
    part_of = labels(tails, heads, len(verts))[faces[:, 0]]
    surface = float(areas(verts[faces]).sum())
    parts: list[Triangles] = []
    for part in np.unique(part_of):
        found = _closed_part(verts, faces[part_of == part], CAP_SHARE * surface)
        if found is None:
            return None
        parts.extend(found)
    parts = _without_sheets(parts, SHEET_SHARE * surface)
    whole = parts[0] if len(parts) == 1 else _united(parts)
    return whole if whole is not None and is_closed(torch.from_numpy(whole[1])) else None


def distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each distinct row of whole numbers stands first, in order of the rows, and which it is.

    The same as NumPy's `unique` along the first axis has, by numbers in place of bytes.
    """
    key, spans = np.zeros(len(rows), dtype=np.int64), 1
    for column in rows.T:
        low, high = (int(end) for end in (column.min(initial=0), column.max(initial=0)))
        spans *= high - low + 1
        if spans > np.iinfo(np.int64).max:
            key, column = (np.unique(x, return_inverse=True)[1] for x in (key, column))
            low, high = 0, len(rows)
            spans = len(rows) * (high + 1)
        key = key * (high - low + 1) + (column - low)
    _, first, same = np.unique(key, return_index=True, return_inverse=True)
    return first, same


def areas(corners: np.ndarray) -> np.ndarray:
    """Areas of triangles given by their corners [m²]."""
    a, b, c = np.moveaxis(corners, -2, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def volumes(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Component of each face, and the signed volume of each component [m³]."""
    tails, heads = half_edges(faces)
    _, part_of = np.unique(labels(tails, heads, len(verts))[faces[:, 0]], return_inverse=True)
    a, b, c = np.moveaxis(verts[faces] - verts.mean(0), 1, 0)
    return part_of, np.bincount(part_of, (np.cross(a, b) * c).sum(-1) / 6)


def _closed_part(verts: np.ndarray, faces: np.ndarray, largest: float) -> list[Triangles] | None:
    """A connected part as manifold solids, wound outward, and sheets; None if it is open.

    Args:
        verts: Vertices of all parts.
        faces: Triangles of this one.
        largest: Area of the largest hole to cap [m²].
    """
    import igl

    for turned in (faces, np.ascontiguousarray(igl.bfs_orient(faces)[0])):
        found = manifold(*_capped(verts, turned, largest))
        if found is not None:
            break
    else:
        return None
    points, closed = found
    part_of, volume = volumes(points, closed)
    closed = np.where((volume < 0)[part_of][:, None], closed[:, ::-1], closed)
    return [(points, closed[part_of == part]) for part in range(len(volume))]


def _without_sheets(parts: list[Triangles], largest: float) -> list[Triangles]:
    """The solids among the parts; none if the sheets are more than flaws, or hold up the box."""
    corners = [verts[faces].reshape(-1, 3) for verts, faces in parts]
    limit = THIN * float(np.ptp(np.vstack(corners), axis=0).max()) ** 3
    thin = [abs(volumes(*part)[1].sum()) < limit for part in parts]
    solids = [part for part, flat in zip(parts, thin, strict=True) if not flat]
    sheets = [place for place, flat in zip(corners, thin, strict=True) if flat]
    if not solids or not sheets:
        return solids
    rest = np.vstack([place for place, flat in zip(corners, thin, strict=True) if not flat])
    loose = np.vstack(sheets)
    held = (loose >= rest.min(0)).all() and (loose <= rest.max(0)).all()
    small = areas(loose.reshape(-1, 3, 3)).sum() <= largest
    return solids if held and small else []


def _capped(verts: np.ndarray, faces: np.ndarray, largest: float) -> Triangles:
    """With fans over the holes that are flat and no larger than `largest` [m²]."""
    flat = FLAT * np.ptp(verts[faces].reshape(-1, 3), axis=0).max()
    for loop in _holes(faces, len(verts)):
        rim, center = verts[loop], verts[loop].mean(0)
        across = np.linalg.svd(rim - center)[2][-1]
        is_flat = np.abs((rim - center) @ across).max() <= flat
        hull = np.cross(rim - center, np.roll(rim, -1, axis=0) - center).sum(0) / 2
        if is_flat and np.linalg.norm(hull) <= largest:
            fan = np.stack([loop, np.roll(loop, -1), np.full(len(loop), len(verts))], -1)
            verts, faces = np.vstack([verts, center]), np.vstack([faces, fan])
    return verts, faces


def _holes(faces: np.ndarray, count: int) -> list[np.ndarray]:
    """Vertices around each hole, in the order of the faces that would fill it."""
    tails, heads = half_edges(faces)
    free = ~np.isin(tails * count + heads, heads * count + tails)
    following = dict(zip(heads[free].tolist(), tails[free].tolist(), strict=True))
    if len(following) < free.sum():
        return []  # two holes meet at a vertex: there is no one way to fill them
    holes: list[np.ndarray] = []
    while following:
        start, vertex = following.popitem()
        loop = [start]
        while vertex != start and vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == start:
            holes.append(np.array(loop))
    return holes


def _united(parts: list[Triangles]) -> Triangles | None:
    import manifold3d

    if not parts:
        return None
    solids = [
        manifold3d.Manifold(manifold3d.Mesh64(np.ascontiguousarray(verts), faces.astype(np.uint64)))
        for verts, faces in parts
    ]
    if any(one.is_empty() for one in solids):
        return None
    mesh = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add).to_mesh64()
    return np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(np.int64)


# How the triangles of a surface hang together: half-edges, neighbours, components.
#
# Half-edge 3 f + k of face f runs from its corner k to its corner k + 1. A surface is closed and
# wound in one orientation when every half-edge has a mate that runs the other way. Where two pairs
# of faces share one edge (solids that touch, marching cubes), every half-edge still gets one mate.


def is_closed(faces: Int[Tensor, "faces 3"]) -> bool:
    """Whether every edge has exactly two faces, which run along it in opposite directions."""
    tails, heads = half_edges(as_int64(faces))
    if len(tails) == 0 or (tails == heads).any():
        return False
    size = int(max(tails.max(), heads.max())) + 1
    forward = np.sort(tails * size + heads)
    return bool((forward[1:] != forward[:-1]).all()) and np.array_equal(
        forward, np.sort(heads * size + tails)
    )


def edges_of(faces: Int[Tensor, "faces 3"]) -> Int[Tensor, "edges 4"]:
    """Edges of a closed surface: two vertices, then the face that runs v0 to v1, and its mate.

    An edge that four faces share appears twice, each time with faces of one component if possible.

    Raises:
        ValueError: If the surface is open or its faces are not wound in one orientation.
    """
    corners = as_int64(faces)
    mates = mates_of(corners)
    if mates is None:
        raise ValueError("edges_of: the mesh is open or its winding is inconsistent; close it")
    tails, heads = half_edges(corners)
    first = np.nonzero(tails < heads)[0]
    rows = np.stack([tails[first], heads[first], first // 3, mates[first] // 3], -1)
    return torch.from_numpy(rows).to(faces)


def half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second vertex of the half-edges 3 f + k."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def mates_of(faces: np.ndarray, verts: np.ndarray | None = None) -> np.ndarray | None:
    """The opposite half-edge of each; None if the surface is not closed or not consistent.

    Args:
        faces: Triangles, none of them degenerate.
        verts: If given, those of one component around a shared edge are paired as the walls of a
            wedge of matter; otherwise in the order of the faces.
    """
    tails, heads = half_edges(faces)
    low, high = np.minimum(tails, heads), np.maximum(tails, heads)
    _, edge = np.unique(low * (faces.max() + 1) + high, return_inverse=True)
    if (tails == heads).any():
        return None
    forward, backward = _by_edge(edge, tails == low), _by_edge(edge, tails != low)
    if len(forward) != len(backward) or (edge[forward] != edge[backward]).any():
        return None
    mates = np.empty(len(tails), dtype=np.int64)
    mates[forward], mates[backward] = backward, forward
    shared = np.nonzero(np.bincount(edge[forward]) > 1)[0]
    if len(shared):
        _pair_shared(mates, edge, shared, faces, verts)
    return mates


def _by_edge(edge: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen half-edges, sorted by their edge."""
    index = np.nonzero(chosen)[0]
    return index[np.argsort(edge[index], kind="stable")]


def _pair_shared(
    mates: np.ndarray,
    edge: np.ndarray,
    shared: np.ndarray,
    faces: np.ndarray,
    verts: np.ndarray | None,
) -> None:
    """Set the mates of the half-edges on edges that more than two faces share."""
    busy = np.isin(edge, shared)
    half = np.arange(len(edge))
    lone = half[~busy & (half < mates)]
    component = labels(lone // 3, mates[lone] // 3, len(faces))
    tails, heads = half_edges(faces)
    order = np.nonzero(busy)[0]
    order = order[np.argsort(edge[order], kind="stable")]
    for group in np.split(order, np.flatnonzero(np.diff(edge[order])) + 1):
        ahead = tails[group] < heads[group]
        out, back = group[ahead], group[~ahead]
        cost = (component[out // 3][:, None] != component[back // 3]) * 2 * np.pi
        if verts is not None:
            cost = cost + _wedges(out, back, faces, verts)
        back = back[_matched(cost)]
        mates[out], mates[back] = back, out


def _wedges(out: np.ndarray, back: np.ndarray, faces: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """Angle of the matter between each two faces around an edge [rad], in [0, 2 pi).

    Around an edge that points at the viewer, the normal of a face that runs along it points
    counter-clockwise: matter begins there, clockwise, and ends at the next face.
    """
    root, tip = faces[out[0] // 3, out[0] % 3], faces[out[0] // 3, (out[0] + 1) % 3]
    along = verts[tip] - verts[root]
    halves = np.concatenate([out, back])
    apexes = verts[faces[halves // 3, (halves + 2) % 3]] - verts[root]
    apexes = apexes - np.outer(apexes @ along, along) / max(float(along @ along), 1e-300)
    side = np.cross(along, apexes[0])
    angle = np.arctan2(apexes @ side, apexes @ apexes[0] * np.linalg.norm(along))
    return (angle[: len(out), None] - angle[len(out) :]) % (2 * np.pi)


def _matched(cost: np.ndarray) -> np.ndarray:
    """A column of its own for each row, the cheapest first."""
    cost, chosen = cost.astype(np.float64), np.zeros(len(cost), dtype=np.int64)
    for _ in range(len(cost)):
        row, column = np.unravel_index(cost.argmin(), cost.shape)
        chosen[row] = column
        cost[row], cost[:, column] = np.inf, np.inf
    return chosen


def labels(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Component of each of `count` nodes that the links a-b join."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def manifold(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The same closed surface with exactly two faces at every edge; None if it is not closed.

    Every fan of mated faces around a vertex gets a vertex of its own. An edge that still has four
    faces, because its two pairs belong to one fan at both ends, gets a middle for one pair.
    """
    while True:
        mates = mates_of(faces, verts)
        if mates is None:
            return None
        half = np.arange(len(mates))
        after = half - half % 3 + (half + 1) % 3  # a corner has the number of its half-edge
        starts, ends = np.concatenate([half, after]), np.concatenate([after[mates], mates])
        fan = labels(starts, ends, len(mates))
        verts = verts[faces.ravel()[np.unique(fan, return_index=True)[1]]]
        faces = fan.reshape(-1, 3)
        tails, heads = half_edges(faces)
        _, first = np.unique(tails * len(verts) + heads, return_index=True)
        again = tails < heads
        again[first] = False
        twice = np.flatnonzero(again)
        if len(twice) == 0:
            return verts, faces
        verts, faces = _with_middle(verts, faces, int(twice[0]), int(mates[twice[0]]))


def _with_middle(
    verts: np.ndarray, faces: np.ndarray, half: int, mate: int
) -> tuple[np.ndarray, np.ndarray]:
    """With a vertex in the middle of the edge between two mated half-edges."""
    middle, pieces = len(verts), list[list[int]]()
    for one in (half, mate):
        tail, head, apex = np.roll(faces[one // 3], -(one % 3)).tolist()
        pieces += [[tail, middle, apex], [middle, head, apex]]
    point = verts[faces[half // 3, [half % 3, (half + 1) % 3]]].mean(0)
    rest = np.delete(faces, [half // 3, mate // 3], axis=0)
    return np.vstack([verts, point]), np.vstack([rest, pieces])
