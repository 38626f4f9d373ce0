"""Signed distance on a regular grid: the space that bodies have moved through.

The sign is the winding number of the cell centres, found from signed crossings of vertical lines
with the triangles, so that a hand inside a thigh is inside. The distance is exact, and computed
only where the collision term looks: inside, and up to two cells from the surface.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from threading import Lock

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..records import record
from .nearest import as_float64, as_int64, closest
from .voxels import REACH, near_surface, outward, winding

SHELL = 2.0  # [cells], up to where it is exact outside: what `near_surface` finds, more than a
# cell's diagonal
BAND = 4.0  # [cells], what stands for any larger distance


@record
class Volume:
    """A scalar field sampled at the centres of cubic cells."""

    values: Float[Tensor, "x y z"]
    """Signed distance [m], negative inside; a positive constant away from the bodies."""
    origin: Float[Tensor, "3"]
    """Centre of cell (0, 0, 0) in the world [m]."""
    cell: float
    """Edge of a cell [m]."""


def sample(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Trilinear value of the field at world points [m].

    A point outside of the outermost cell centres gets the border's value, or zero where that is
    negative, and no gradient.
    """
    values = volume.values
    half = (torch.tensor(values.shape, dtype=points.dtype, device=points.device) - 1) / 2
    place = (points - volume.origin.to(points)) / volume.cell / half - 1
    found = torch.nn.functional.grid_sample(
        values.permute(2, 1, 0)[None, None],
        place.reshape(1, -1, 1, 1, 3).to(values.dtype),
        align_corners=True,
        padding_mode="border",
    )
    found = found.reshape(points.shape[:-1]).to(points.dtype)
    outside = (place.abs() > 1).any(-1)
    return torch.where(outside, found.detach().clamp_min(0), found)


def grid_around(
    low: Float[Tensor, "3"], high: Float[Tensor, "3"], cells: int = 256, padding: float = 0.2
) -> Volume:
    """Empty space around the box from `low` to `high` [m], nothing inside yet.

    Args:
        low: Corner of the box.
        high: Opposite corner.
        cells: Number of cells along the longest side.
        padding: Room on every side of the box [m].

    Raises:
        ValueError: If the box is turned inside out, not finite, or there are too few cells.
    """
    if cells < 2 or not bool((high >= low).all() and (high - low).isfinite().all()):
        raise ValueError(f"grid_around: {cells} cells from {low.tolist()} to {high.tolist()}")
    size = (high - low + 2 * padding).double()
    cell = float(size.max() / cells)
    if cell <= 0:
        raise ValueError("grid_around: the box is a point, expected a size or a padding above 0")
    counts = (size / cell - 1e-9).ceil().long().clamp_min(2)
    first = (low.double() + high.double()) / 2 - cell * (counts - 1) / 2
    values = torch.full(counts.tolist(), BAND * cell, dtype=low.dtype, device=low.device)
    return Volume(values, first.to(low), cell)


def union_bodies(
    verts: Float[Tensor, "bodies verts 3"],
    faces: Int[Tensor, "faces 3"],
    grid: Volume,
    workers: int = 2,
    observe: Callable[[int, int], None] | None = None,
) -> Volume:
    """V = min over the bodies, and what `grid` holds, of the signed distance to each [m].

    Exact inside the bodies and up to two cells outside; further away as in `grid`. The result
    does not depend on the number of workers, and memory not on that of bodies.

    Args:
        verts: Closed bodies in the world [m].
        faces: Their triangles, one orientation, outward or inward.
        grid: Where to measure; `grid_around` makes an empty one.
        workers: Bodies measured at the same time.
        observe: Called with (bodies done, bodies) after each body.

    Raises:
        ValueError: If a vertex is not finite.
    """
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


def signed_distance(
    points: Float[Tensor, "points 3"],
    verts: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
) -> Float[Tensor, " points"]:
    """Exact signed distance to a closed surface at any points [m]; the sign by winding number."""
    import igl

    query, corners = as_float64(points), as_float64(verts)
    triangles = outward(corners, as_int64(faces))
    distance = np.sqrt(closest(query, corners, triangles)[0])
    inside = np.asarray(igl.fast_winding_number(corners, triangles, query)) > 0.5
    return torch.from_numpy(np.where(inside, -distance, distance)).to(points)
