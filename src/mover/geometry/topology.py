"""Closed parts of a mesh as one solid, without resampling."""

from collections.abc import Sequence
from typing import Any

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
    if len(parts) != 1:
        import manifold3d

        solids = [_as_solid(*part) for part in parts]
        if not solids or any(one.is_empty() for one in solids):
            return None
        union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
        parts = [_as_triangles(union)]
    return parts[0] if is_closed(torch.from_numpy(parts[0][1])) else None


def areas(corners: np.ndarray) -> np.ndarray:
    """Areas of triangles given by their corners [m²]."""
    a, b, c = np.moveaxis(corners, -2, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def volumes(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Component of each face, by common edges, and the signed volume of each component [m³]."""
    import igl

    if len(faces) == 0:
        return faces[:, 0], np.zeros(0)
    part_of = np.asarray(igl.facet_components(faces)[1])
    a, b, c = np.moveaxis(verts[faces] - verts.mean(0), 1, 0)
    return part_of, np.bincount(part_of, (np.cross(a, b) * c).sum(-1) / 6)


def level_set(
    values: np.ndarray, start: Sequence[float] | np.ndarray, cell: float, level: float
) -> Triangles:
    """Where values on a grid (x, y, z) from `start` on [m] have a level, by marching cubes."""
    import igl

    axes = [s + cell * np.arange(n) for s, n in zip(start, values.shape, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")  # x runs fastest in libigl
    places = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
    flat = np.ascontiguousarray(values.transpose(2, 1, 0).ravel())
    verts, faces, _ = igl.marching_cubes(flat, places, *values.shape, isovalue=level)
    return np.asarray(verts), np.asarray(faces, dtype=np.int64)


def _closed_part(verts: np.ndarray, faces: np.ndarray, largest: float) -> list[Triangles] | None:
    """A connected part as manifold solids, wound outward, and sheets; None if it is open.

    `verts` are those of all parts; holes up to the area `largest` are capped [m²].
    """
    import igl

    for turned in (faces, np.ascontiguousarray(igl.bfs_orient(faces)[0])):
        capped = _capped(verts, turned, largest)
        found = manifold(*capped)
        if found is not None:
            break
    else:
        return None
    points, closed = found
    part_of, volume = volumes(points, closed)
    closed = np.where((volume < 0)[part_of][:, None], closed[:, ::-1], closed)
    parts = [(points, closed[part_of == part]) for part in range(len(volume))]
    sheet = capped[1][_doubled(capped[1])]
    return [*parts, (capped[0], sheet)] if len(sheet) else parts


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


def _as_solid(verts: np.ndarray, faces: np.ndarray) -> Any:  # noqa: ANN401
    """As `manifold3d` has it; empty where it is not closed."""
    import manifold3d

    mesh = manifold3d.Mesh64(np.ascontiguousarray(verts, np.float64), faces.astype(np.uint64))
    return manifold3d.Manifold(mesh)


def _as_triangles(solid: Any) -> Triangles:  # noqa: ANN401
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts).astype(np.int64)


def manifold(verts: np.ndarray, faces: np.ndarray) -> Triangles | None:
    """The same closed surface with exactly two faces at every edge; None if it is not closed.

    Faces that lie on one another are left out. Where the pairs of faces at an edge do not come
    apart by copies of its ends, it gets a vertex in its middle.
    """
    if is_closed(torch.from_numpy(faces)):  # its vertices come in the order of the faces
        _, first, corner = np.unique(faces, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))
        return verts[faces.ravel()[np.sort(first)]], rank[corner].reshape(-1, 3)
    faces = faces[~_doubled(faces)]
    found = _as_solid(verts, faces)
    if found.num_tri() < len(faces):
        ends = np.sort(np.stack(half_edges(faces), -1), -1)
        edges, count = np.unique(ends, axis=0, return_counts=True)
        for a, b in edges[count > 2]:
            verts = np.vstack([verts, (verts[a] + verts[b]) / 2])
            shared = (faces == a).any(1) & (faces == b).any(1)
            halves = [
                np.where(faces[shared] == end, len(verts) - 1, faces[shared]) for end in (a, b)
            ]
            faces = np.concatenate([faces[~shared], *halves])
        found = _as_solid(verts, faces)
    return None if found.is_empty() and len(faces) else _as_triangles(found)


def _doubled(faces: np.ndarray) -> np.ndarray:
    """Which faces lie on another one, its back."""
    _, same, count = np.unique(np.sort(faces), axis=0, return_inverse=True, return_counts=True)
    return count[same.ravel()] == 2


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

    An edge that four faces share appears twice, its faces paired in their order.

    Raises:
        ValueError: If the surface is open or its faces are not wound in one orientation.
    """
    tails, heads = half_edges(as_int64(faces))
    size = int(max(tails.max(initial=0), heads.max(initial=0))) + 1
    ahead, back = np.flatnonzero(tails < heads), np.flatnonzero(heads < tails)
    edge, mate = tails[ahead] * size + heads[ahead], heads[back] * size + tails[back]
    order, other = np.argsort(edge, kind="stable"), np.argsort(mate, kind="stable")
    if len(ahead) + len(back) < len(tails) or not np.array_equal(edge[order], mate[other]):
        raise ValueError("edges_of: the mesh is open or its winding is inconsistent; close it")
    mates = np.empty(len(ahead), dtype=np.int64)
    mates[order] = back[other]
    rows = np.stack([tails[ahead], heads[ahead], ahead // 3, mates // 3], -1)
    return torch.from_numpy(rows).to(faces)


def half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second vertex of the half-edges; 3 f + k leaves corner k of face f."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def labels(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Component of each of `count` nodes that the links a-b join."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    return connected_components(links, directed=False)[1]
