"""A closed surface around any triangles, drawn tight.

The distance to the triangles on a grid has no inside and needs none: what cannot be reached from
outside through cells that are far from every triangle is matter. Where holes are small, the winding
number (of either sign) marks the inside as well. The level of that field, a wall of constant
thickness around the triangles, is a closed surface; its vertices then fall back onto the triangles
up to a small rest, so that neither thickness nor box change and sheets keep two sides.
"""

from typing import Any

import numpy as np
import torch
from torch.nn.functional import interpolate

from mover.core.types import Mesh
from mover.geometry.mesh import decimate, fit_box, used
from mover.geometry.nearest import as_float64, as_int64, closest
from mover.geometry.topology import (
    Triangles,
    areas,
    is_closed,
    labels,
    level_set,
    manifold,
    solid,
    volumes,
)
from mover.geometry.volume import BAND, SHELL, Volume, union_bodies

WALL = 0.75  # [cells], more than the half diagonal of a step, or the flood would leak through
REST = 0.3  # of the thickness of the wall that stays: sheets need two sides that are apart
REACH = 3.0  # [walls], vertices further from the triangles stay where they are: lids over holes
INSIDE = 0.85  # winding number from which a place that the flood reached still counts as matter
LID = 4.0  # [cells] over which a winding number that is larger by 1 would lower the field
FAR = 4  # [cells], step between winding numbers far from the triangles
MARGIN = 2  # [cells] of air around the box
SPECK = 1e-3  # of the largest component's volume: what is smaller is no part of the furniture


def wrap(verts: np.ndarray, faces: np.ndarray, cells: int) -> Triangles:
    """A closed, outward-wound surface around the triangles; `cells` along the longest side."""
    low, high = verts[faces].min((0, 1)), verts[faces].max((0, 1))
    cell = float((high - low).max()) / cells
    counts = np.ceil((high - low) / cell).astype(np.int64) + 1 + 2 * MARGIN
    start = (low + high) / 2 - cell * (counts - 1) / 2
    field = _field(verts, faces, start, cell, counts)
    points, shell = _bodies(*level_set(field, start, cell, WALL * cell))
    squared, _, onto = closest(points, verts, faces)  # which lay a wall's thickness away
    distance, wall = np.sqrt(squared)[:, None], WALL * cell
    pull = np.clip((REACH * wall - distance) / ((REACH - 1) * wall), 0, 1)
    step = np.minimum((1 - REST) * wall * pull / np.maximum(distance, 1e-300), 1)
    return points + step * (onto - points), shell


def _field(
    verts: np.ndarray, faces: np.ndarray, start: np.ndarray, cell: float, counts: np.ndarray
) -> np.ndarray:
    """Distance to the triangles [m] where air is; at most that, and below the wall, in matter."""
    from scipy.ndimage import label

    wall, far = WALL * cell, torch.full(counts.tolist(), BAND * cell, dtype=torch.float32)
    grid = Volume(far, torch.zeros(3), cell)  # from its corner: kernels count in single precision
    corners = torch.from_numpy(verts - start).float()[None]
    distance = union_bodies(corners, torch.from_numpy(faces), grid).values.abs().double().numpy()
    found: Any = label(distance > wall)
    region = np.asarray(found[0])
    air = (distance > wall) & (region == region[0, 0, 0])  # in steps from the grid's first corner
    field = np.where(air, distance, np.minimum(distance, wall / 2))
    shell = ~air & (distance <= wall)
    field[shell] = distance[shell]
    winding = _windings(verts, faces, start, cell, distance < SHELL * cell, air)
    winding = np.pad(winding[1:-1, 1:-1, 1:-1], 1)  # the border of the grid is air in any case
    lid = wall + (INSIDE - winding) * LID * cell
    return np.where(air, np.minimum(field, lid), field)


def _windings(
    verts: np.ndarray,
    faces: np.ndarray,
    start: np.ndarray,
    cell: float,
    near: np.ndarray,
    air: np.ndarray,
) -> np.ndarray:
    """Winding number, of either sign, of the air's positions; zero elsewhere.

    It changes little from one to the next but across triangles: it is exact near them (within
    `SHELL` cells), and interpolated between every fourth position along the axes elsewhere.
    """
    import igl

    counts = [-(-(n - 1) // FAR) + 1 for n in air.shape]
    places = start + cell * FAR * np.argwhere(np.ones(counts, dtype=bool))
    coarse = np.abs(igl.fast_winding_number(verts, faces, places)).reshape(1, 1, *counts)
    size = [FAR * (n - 1) + 1 for n in counts]
    whole = interpolate(torch.from_numpy(coarse), size, mode="trilinear", align_corners=True)
    x, y, z = air.shape
    winding = np.where(air, whole[0, 0, :x, :y, :z].numpy(), 0.0)
    exact = air & near
    places = start + cell * np.argwhere(exact)
    winding[exact] = np.abs(igl.fast_winding_number(verts, faces, places))
    return winding


def _bodies(points: np.ndarray, shell: np.ndarray) -> Triangles:
    """The outer surfaces of the larger bodies, each edge with two faces."""
    part_of, volume = volumes(points, shell)
    if volume[np.abs(volume).argmax()] < 0:
        shell, volume = shell[:, ::-1].copy(), -volume
    shell = shell[(volume > SPECK * volume.max())[part_of]]
    closed = manifold(points, shell)
    assert closed is not None  # as the border of the grid is air
    return closed


LARGE, LIGHT = 20_000, 10_000  # faces of an open mesh that is made lighter, and what is left
WELD = 1e-6  # [longest side], vertices this near are one


def close_mesh(mesh: Mesh, cells: int = 96) -> Mesh:
    """One closed mesh, wound counter-clockwise seen from outside, in the box of the input.

    A closed, consistently wound mesh passes through: turned over if it is inside out, with
    duplicate vertices merged. Several closed parts are united. Everything else (holes, double-sided
    faces, soups) is wrapped at a resolution of 1/cells of the longest side, which has no use for
    more than `LIGHT` triangles. Degenerate ones and unused vertices do not count.

    Raises:
        ValueError: If the mesh has no triangle with an area, or vertices that are not finite.
    """
    verts, faces = as_float64(mesh.verts), as_int64(mesh.faces)
    if not np.isfinite(verts[faces]).all():
        raise ValueError("close_mesh: the mesh has vertices that are not finite")
    if not (areas(verts[faces]) > 0).any():
        raise ValueError("close_mesh: the mesh has no triangle with an area")
    low, high = verts[faces].min((0, 1)), verts[faces].max((0, 1))
    verts, faces = _cleaned(verts, faces)
    if len(faces) > LARGE and not is_closed(torch.from_numpy(faces)):
        light = decimate(Mesh(torch.from_numpy(verts), torch.from_numpy(faces)), LIGHT)
        verts, faces = as_float64(light.verts), as_int64(light.faces)
    found = solid(verts, faces)
    if found is None:
        found = wrap(verts, faces, cells)
    closed = used(Mesh(torch.from_numpy(found[0]), torch.from_numpy(found[1])))
    closed = fit_box(closed, torch.from_numpy(low), torch.from_numpy(high))
    return Mesh(closed.verts.to(mesh.verts), closed.faces.to(mesh.faces))


def _cleaned(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without duplicate and unused vertices, repeated faces, and faces that are no triangles."""
    from scipy.spatial import KDTree

    name, faces = np.unique(faces, return_inverse=True)
    verts, faces = verts[name], faces.reshape(-1, 3)
    pairs = KDTree(verts).query_pairs(WELD * np.ptp(verts, axis=0).max(), output_type="ndarray")
    place = labels(pairs[:, 0], pairs[:, 1], len(verts))
    verts, faces = verts[np.unique(place, return_index=True)[1]], place[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    turned = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    return verts, faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]
