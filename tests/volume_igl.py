"""The union of bodies by numpy and libigl: the reference of `volume_warp`, in any precision."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from threading import Lock

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.nearest import as_float64, as_int64, closest
from mover.geometry.volume import BAND, SHELL, Volume, outward

SPACING = 0.8  # [cells] between marks on the surface; no point is further than 0.47 from one
REACH = 2  # [cells] along each axis from the cell of a mark


def union_bodies(
    verts: Float[Tensor, "bodies verts 3"],
    faces: Int[Tensor, "faces 3"],
    grid: Volume,
    workers: int = 2,
    observe: Callable[[int, int], None] | None = None,
) -> Volume:
    """See `volume.union_bodies`."""
    values = grid.values.detach().cpu().numpy().copy()
    triangles, origin, lock = as_int64(faces), as_float64(grid.origin), Lock()

    def add(body: int) -> None:
        points = (as_float64(verts[body]) - origin) / grid.cell
        if not np.isfinite(points).all():
            raise ValueError(f"union_bodies: body {body} has vertices that are not finite")
        add_body(points, outward(points, triangles), values, grid.cell, lock)

    with ThreadPoolExecutor(workers) as pool:
        jobs = [pool.submit(add, body) for body in range(len(verts))]
        for done, job in enumerate(as_completed(jobs), 1):
            job.result()
            if observe is not None:
                observe(done, len(jobs))
    return replace(grid, values=torch.from_numpy(values).to(grid.values))


def add_body(
    verts: np.ndarray, faces: np.ndarray, values: np.ndarray, cell: float, lock: Lock
) -> None:
    """Lower `values` [m] to the signed distance of one body whose vertices are in cells."""
    size = np.array(values.shape)
    low = np.maximum(np.floor(verts.min(0)).astype(np.int64), 0) - REACH
    high = np.minimum(np.ceil(verts.max(0)).astype(np.int64), size - 1) + REACH
    if (high < 0).any() or (low >= size).any():
        return
    shape = high - low + 1
    place = np.stack(np.indices(shape), -1).reshape(-1, 3) + low
    numbers = np.asarray(igl.fast_winding_number(verts, faces, place.astype(np.float64)))
    inside = (numbers > 0.5).reshape(shape)
    near = np.flatnonzero(inside | near_surface(verts - low, faces, shape))
    at = place[near]
    is_in = np.asarray(inside.ravel()[near])
    keep = ((at >= 0) & (at < size)).all(-1)
    at, is_in = at[keep], is_in[keep]
    flat = np.asarray(np.ravel_multi_index(tuple(at.T), values.shape))
    field: np.ndarray = values.reshape(-1)
    open_ = is_in | (field[flat] > 0)  # a positive distance cannot lower what is not positive
    at, is_in, flat = at[open_], is_in[open_], flat[open_]
    if len(at) == 0:
        return
    distance = np.sqrt(closest(at.astype(np.float64), verts, faces)[0])
    signed = np.where(is_in, -distance, np.where(distance <= SHELL, distance, BAND)) * cell
    with lock:
        field[flat] = np.minimum(field[flat], signed.astype(values.dtype))


def near_surface(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The places below `shape` that are nearer than two cells to the surface, and some more.

    Such a place is less than 2 + 0.47 + 0.5 cells from a marked one along any axis (the distance
    to a point of the surface, from there to the next mark, and the mark's rounding): at most
    `REACH` whole cells.
    """
    return _grown(_marks(verts, faces, shape), REACH)


def _marks(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Cells of points on the surface, no further apart than SPACING."""
    corners = verts[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(-1)
    parts = np.maximum(np.ceil(longest / SPACING), 1).astype(np.int64)
    marks = np.zeros(shape, dtype=bool)
    for count in np.unique(parts):
        i, j = np.nonzero(np.tri(count + 1, dtype=bool)[::-1])
        share = np.stack([i, j, count - i - j], -1) / count
        points = np.rint(share @ corners[parts == count]).astype(np.int64).reshape(-1, 3)
        points = points[((points >= 0) & (points < shape)).all(-1)]
        marks[tuple(points.T)] = True
    return marks


def _grown(mask: np.ndarray, cells: int) -> np.ndarray:
    """The mask and everything within `cells` of it along each axis."""
    for axis in range(3):
        view = np.moveaxis(mask, axis, 0)
        grown = view.copy()
        for step in range(1, cells + 1):
            grown[step:] |= view[:-step]
            grown[:-step] |= view[step:]
        mask = np.moveaxis(grown, 0, axis)
    return mask
