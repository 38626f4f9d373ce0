"""Closed parts of a mesh as one solid, without resampling."""

import numpy as np
import torch

from .topology import half_edges, is_closed, labels, manifold

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
