"""Triangle meshes: boxes, normals, even samples, fewer points and faces that show the shape."""

from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.types import Mesh
from mover.geometry.nearest import as_float64, as_int64, closest, enclosed
from mover.geometry.topology import edges_of as edges_of
from mover.geometry.topology import is_closed as is_closed
from mover.geometry.topology import manifold, volumes

OVERSAMPLING = 5  # candidates for each even sample
TRIED = 8000  # vertices, at least, of a heavy mesh that are looked at
STRAY = 0.03  # of the longest side; no vertex may be further from the decimated surface
FOLD = 1e-9  # of the cube of the longest side; closed pieces of less volume are folded faces
CAUTION = 5  # of fast_simplification: 7 is its default, less is slower and better
AT_ONCE = 16  # meshes whose normals are found together: what fits a processor's cache
GENTLER = 1.5  # a target of faces that spoils a mesh is raised by this factor


def box(verts: Float[Tensor, "verts 3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Lowest and highest coordinates of the vertices [m].

    Raises:
        ValueError: If there are no vertices.
    """
    if len(verts) == 0:
        raise ValueError("box: 'verts' is empty, expected at least one vertex")
    return verts.amin(0), verts.amax(0)


def bottom_center(
    low: Float[Tensor, "*items 3"], high: Float[Tensor, "*items 3"]
) -> Float[Tensor, "*items 3"]:
    """Centre of the bottom of boxes from their lowest and highest corners: the origin of frames."""
    middle = (low + high) / 2
    return torch.stack([middle[..., 0], low[..., 1], middle[..., 2]], -1)


def used(mesh: Mesh) -> Mesh:
    """The mesh without the vertices that no face refers to."""
    keep, faces = torch.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.verts[keep], faces.to(mesh.faces))


def fit_box(mesh: Mesh, low: Float[Tensor, "3"], high: Float[Tensor, "3"]) -> Mesh:
    """The mesh stretched so that its box runs from `low` to `high` [m].

    Along an axis where either has no extent the mesh is only centred.
    """
    start, end = box(mesh.verts)
    flat = (end <= start) | (high <= low)
    factor = torch.where(flat, 1.0, (high - low) / torch.where(flat, 1.0, end - start))
    verts = (mesh.verts - (start + end) / 2) * factor + (low + high) / 2
    held = torch.minimum(torch.maximum(verts, low), high)  # rounding
    return Mesh(torch.where(flat, verts, held), mesh.faces)


def signed_volume(mesh: Mesh) -> float:
    """Enclosed volume [m³], positive where faces wind counter-clockwise seen from outside."""
    verts = mesh.verts.detach().double()
    a, b, c = (verts - verts.mean(0))[mesh.faces].unbind(-2)
    return float((torch.linalg.cross(a, b) * c).sum() / 6)


def face_normals(
    verts: Float[Tensor, "*b verts 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*b faces 3"]:
    """Unit normals of the faces; zero for a face without area."""
    return torch.nn.functional.normalize(_area_vectors(verts, faces), dim=-1)


def vertex_normals(
    verts: Float[Tensor, "*b verts 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*b verts 3"]:
    """Unit normals at the vertices: of their faces, weighted by area; zero where there are none."""
    rows: list[Tensor] = []
    for some in verts.reshape(-1, *verts.shape[-2:]).split(AT_ONCE):
        flat = some.movedim(-2, 0).reshape(some.shape[-2], -1)
        a, b, c = (flat.index_select(0, k).reshape(len(k), -1, 3) for k in faces.unbind(-1))
        vectors = torch.linalg.cross(b - a, c - a).reshape(len(faces), -1).repeat_interleave(3, 0)
        total = torch.zeros_like(flat).index_add(0, faces.reshape(-1), vectors)
        found = torch.nn.functional.normalize(total.unflatten(-1, (-1, 3)), dim=-1)
        rows.append(found.movedim(0, -2))
    return torch.cat(rows).reshape(verts.shape) if rows else verts.clone()


def _area_vectors(
    verts: Float[Tensor, "*b verts 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, "*b faces 3"]:
    """Normals as long as twice the area [m²]; the size does not matter to their direction."""
    a, b, c = verts[..., faces, :].unbind(-2)
    return torch.linalg.cross(b - a, c - a)


def sample_surface(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"]]:
    """Points spread evenly over the surface [m], and the normals there.

    Of `OVERSAMPLING` times as many random points, each next one is the farthest from those
    before; so the first n of the points are even, too.

    Raises:
        ValueError: If the mesh has no area.
    """
    points, normals = scatter(mesh, OVERSAMPLING * count, seed)
    chosen = farthest_first(points, count)
    return points[chosen], normals[chosen]


def scatter(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float[Tensor, "count 3"], Float[Tensor, "count 3"]]:
    """Random points, as many on each face as its area asks [m], face by face, and their normals.

    Raises:
        ValueError: If the mesh has no area.
    """
    verts, rng = mesh.verts.detach(), np.random.default_rng(seed)
    area = _area_vectors(verts, mesh.faces).norm(dim=-1).double().cumsum(0)
    if len(area) == 0 or not float(area[-1]) > 0:
        raise ValueError("sample_surface: the mesh has no area")
    steps = torch.from_numpy((np.arange(count) + rng.random(count)) / count).to(area)
    face = torch.searchsorted(area, steps * area[-1]).clamp_max(len(area) - 1)
    u, v = torch.from_numpy(rng.random((2, count))).to(verts)
    u, v = torch.where(u + v > 1, 1 - u, u)[:, None], torch.where(u + v > 1, 1 - v, v)[:, None]
    a, b, c = verts[mesh.faces[face]].unbind(-2)
    return a + u * (b - a) + v * (c - a), face_normals(verts, mesh.faces)[face]


def decimate(mesh: Mesh, faces: int) -> Mesh:
    """The same shape and box with about `faces` triangles; a closed mesh stays closed.

    Where the target would open the mesh or lose a part of it, a gentler one is taken, and the mesh
    itself where none is left.
    """
    if faces >= len(mesh.faces):
        return mesh
    target, closed = float(faces), is_closed(mesh.faces)
    keep = torch.ones(len(mesh.faces), dtype=torch.bool)
    if closed:  # without the hollows in a solid, which no simplification keeps
        part_of, parts = volumes(as_float64(mesh.verts), as_int64(mesh.faces))
        keep = torch.from_numpy((np.sign(signed_volume(mesh)) * parts > 0)[part_of])
    outer = used(Mesh(mesh.verts, mesh.faces[keep]))
    while target < len(mesh.faces):
        whole = _simplified(mesh, int(target))
        small = _resolidified(whole, mesh) if closed else whole
        if small is not None and _strays(outer, whole, small) <= STRAY:
            return fit_box(small, *box(used(mesh).verts))
        target *= GENTLER
    return mesh


def _strays(mesh: Mesh, whole: Mesh, small: Mesh) -> float:
    """Farthest vertex of a mesh from its simplification, over the longest side of its box.

    Of a mesh of many vertices, which stand closer than that matters, every second, third, ... one.

    What was left out of the whole simplification may lie inside the rest only: a hollow whose way
    out became too narrow is no part of the shape, a leg that was turned inside out is.
    """
    verts = as_float64(mesh.verts)[:: max(1, len(mesh.verts) // TRIED)]
    squared, _, _ = closest(verts, as_float64(whole.verts), as_int64(whole.faces))
    if small is not whole:
        solid = as_float64(small.verts), as_int64(small.faces)
        kept = closest(verts, *solid)[0]
        far = np.flatnonzero(kept > squared)
        outside = far[~enclosed(verts[far], *solid)]
        squared[outside] = kept[outside]
    low, high = box(mesh.verts)
    return float(squared.max() ** 0.5 / (high - low).max())


def _simplified(mesh: Mesh, faces: int) -> Mesh:
    import fast_simplification

    corners, rows = as_float64(mesh.verts), as_int64(mesh.faces).astype(np.int32)
    with simplifying:
        found = fast_simplification.simplify(corners, rows, target_count=faces, agg=CAUTION)
    verts, triangles = (torch.from_numpy(np.ascontiguousarray(part)) for part in found[:2])
    return used(Mesh(verts.to(mesh.verts), triangles.to(mesh.faces)))


def _resolidified(small: Mesh, mesh: Mesh) -> Mesh | None:
    """A simplified solid without the pinches and folds that its collapsed edges left.

    None if it is open, or its volume is not within a factor of two of the one before.
    """
    found = manifold(as_float64(small.verts), as_int64(small.faces))
    if found is None:
        return None
    part_of, parts = volumes(*found)
    before = signed_volume(mesh)
    keep = np.sign(before) * parts > FOLD * np.ptp(found[0], axis=0).max() ** 3
    if not 0.5 <= parts[keep].sum() / before <= 2:
        return None
    verts, faces = (torch.from_numpy(part) for part in (found[0], found[1][keep[part_of]]))
    return used(Mesh(verts.to(mesh.verts), faces.to(mesh.faces)))


simplifying = Lock()  #: held while fast_simplification works: on global variables


def farthest_first(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """The first point, and so on the one that is farthest from all before; the first of equals."""
    x, y, z = np.ascontiguousarray(points.detach().cpu().float().numpy().T)
    chosen = np.zeros(count, dtype=np.int64)
    nearest = np.full(len(x), np.inf, dtype=np.float32)
    for row in range(1, count):
        at = chosen[row - 1]
        np.minimum(nearest, (x - x[at]) ** 2 + (y - y[at]) ** 2 + (z - z[at]) ** 2, out=nearest)
        chosen[row] = nearest.argmax()
    return torch.from_numpy(chosen).to(points.device)


def chosen_vertices(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> tuple[Int[Tensor, " fewer"], Int[Tensor, "triangles 3"]] | None:
    """Vertices that stand for all, and about `count` triangles between them.

    Each vertex of the simplified mesh is replaced by the nearest of those that collapsed into it;
    None where one has none.
    """
    import fast_simplification

    points, rows = as_float64(verts), as_int64(faces).astype(np.int32)
    with simplifying:
        found: Any = fast_simplification.simplify(
            points, rows, target_count=count, return_collapses=True
        )
        fewer, rows, group = fast_simplification.replay_simplification(points, rows, found[2])
    order = np.lexsort([np.linalg.norm(points - fewer[group], axis=1), group])
    nearest = order[np.unique(group[order], return_index=True)[1]]
    if len(nearest) < len(fewer):
        return None
    return torch.from_numpy(nearest), torch.from_numpy(rows.astype(np.int64)).to(faces)


def coarser(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> tuple[Float[Tensor, "meshes fewer 3"], Int[Tensor, "triangles 3"]]:
    """Meshes of one topology with about `count` triangles, all simplified as the first one is.

    Each of the new vertices is an old one. Where the result would not be closed, more triangles
    are kept: up to twice as many, else all, as in meshes of fewer triangles.
    """
    if len(meshes) == 0 or len(faces) <= count:
        return meshes, faces
    for some in (count, 4 * count // 3, 2 * count):
        found = chosen_vertices(meshes[0], faces, some)
        if found is not None and is_closed(found[1]):
            return meshes[:, found[0].to(meshes.device)].contiguous(), found[1]
    return meshes, faces
