"""Signed distance on a regular grid: the space that bodies have moved through.

The sign is the winding number of the cell centres, found from signed crossings of vertical lines
with the triangles, so that a hand inside a thigh is inside. The distance is exact, and computed
only where the collision term looks: inside, and up to two cells from the surface.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from . import sample_warp, volume_igl, volume_warp
from .nearest import as_float64, as_int64, closest
from .raster_engine import engine
from .volume_record import BAND, SHELL, Volume
from .voxels import outward

__all__ = [
    "BAND",
    "SHELL",
    "Volume",
    "grid_around",
    "sample",
    "sample_torch",
    "signed_distance",
    "union_bodies",
]


def sample(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Trilinear value of the field at world points [m].

    A point outside of the outermost cell centres gets the border's value, or zero where that is
    negative, and no gradient.
    """
    plain = {volume.values.dtype, points.dtype} == {torch.float32}
    if engine() == "warp" and plain and points.device == volume.values.device:
        return sample_warp.sample(volume, points)
    return sample_torch(volume, points)


def sample_torch(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """See `sample`; for any precision, and the oracle of the kernel."""
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
    warped = grid.values.dtype == torch.float32 and engine() == "warp"
    measure = volume_warp.union_bodies if warped else volume_igl.union_bodies
    return measure(verts, faces, grid, workers, observe)


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
