"""The union of bodies by numpy and libigl: the oracle of `volume_warp`, and for any precision."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from threading import Lock

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from .nearest import as_float64, as_int64, closest
from .volume_record import BAND, SHELL, Volume
from .voxels import REACH, near_surface, outward, winding


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
    inside = winding(verts - low, faces, shape) > 0
    near = np.flatnonzero(inside | near_surface(verts - low, faces, shape))
    at = np.stack(np.unravel_index(near, inside.shape), -1) + low
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
