"""Signed distance on a regular grid: a volume, its values between the cells, what is inside.

The sign is the winding number of the cell centres, found from signed crossings of vertical lines
with the triangles, so that a hand inside a thigh is inside. The distance is exact, and computed
only where the collision term looks: inside, and up to two cells from the surface.

The union of bodies is found by Warp kernels: signed crossings give the winding numbers, Warp's mesh
the distances. A launch on the CPU is serial but releases Python's lock, so bodies are measured in
threads, each with a volume of its own; the minimum of these is the result.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cached_property
from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from mover.core.records import record
from mover.geometry.nearest import as_float64, as_int64, closest, enclosed
from mover.geometry.warp_start import filled, kernels, launch, name_of, started

SHELL = 2.0  # [cells], up to where it is exact outside: more than a cell's diagonal
BAND = 4.0  # [cells], what stands for any larger distance
BRICK = 8  # [cells]
NEAR = 0.03  # [m], edge of the cubes in which one position stands for its neighbours


@record
class Volume:
    """A scalar field sampled at the centres of cubic cells."""

    values: Float[Tensor, "x y z"]
    """Signed distance [m], negative inside; a positive constant away from the bodies."""
    origin: Float[Tensor, "3"]  #: centre of cell (0, 0, 0) in the world [m]
    cell: float  #: edge of a cell [m]

    @cached_property
    def busy(self) -> UInt8[Tensor, "bx by bz"]:
        """1 for each brick of 8 cells along an axis in which the values change, else 0."""
        low = high = self.values.detach()
        for axis, size in enumerate(self.values.shape):
            index = torch.arange(-(-(size - 1) // BRICK) * BRICK + 1, device=low.device)
            index = index.clamp_max(size - 1)
            low = low.index_select(axis, index).unfold(axis, BRICK + 1, BRICK).amin(-1)
            high = high.index_select(axis, index).unfold(axis, BRICK + 1, BRICK).amax(-1)
        return (low != high).to(torch.uint8)


def sample(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Trilinear value of the field at world points [m].

    A point outside of the outermost cell centres gets the border's value, or zero where that is
    negative, and no gradient.
    """
    plain = {volume.values.dtype, points.dtype} == {torch.float32}
    if plain and points.device == volume.values.device:
        found = _Lookup.apply(points, volume)
        assert isinstance(found, Tensor)
        return found
    return sample_torch(volume, points)


def field_of(volume: Volume, busy: Tensor) -> Any:  # noqa: ANN401
    """The volume as kernels read it: `kernels.lookup.Field`, with what is known of its bricks."""
    from mover.geometry.kernels.lookup import Field

    origin = started().vec3(*volume.origin.tolist())
    return filled(Field, values=volume.values, busy=busy, origin=origin, cell=volume.cell)


class _Lookup(torch.autograd.Function):
    """The lookup as a kernel: value and gradient in one pass, skipping empty space."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, volume: Volume) -> Tensor:  # noqa: ANN401
        wp, lookup = started(), kernels("lookup", name_of(points.device)).lookup
        flat = points.detach().reshape(-1, 3).contiguous()
        found, slope = flat.new_empty(len(flat)), torch.empty_like(flat)
        if len(flat):
            at, slopes = (wp.from_torch(x, dtype=wp.vec3) for x in (flat, slope))
            field = field_of(volume, volume.busy)
            launch(lookup, len(flat), [field, at, wp.from_torch(found), slopes], flat.device)
        ctx.save_for_backward(slope)
        return found.reshape(points.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope.reshape(*grads[0].shape, 3) * grads[0].unsqueeze(-1), None


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

    It has `cells` along the longest side, and room on every side of the box (`padding`).

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


def signed_distance(
    points: Float[Tensor, "points 3"],
    verts: Float[Tensor, "verts 3"],
    faces: Int[Tensor, "faces 3"],
) -> Float[Tensor, " points"]:
    """Exact signed distance to a closed surface at any points [m]; the sign by winding number."""
    query, corners = as_float64(points), as_float64(verts)
    triangles = outward(corners, as_int64(faces))
    distance = np.sqrt(closest(query, corners, triangles)[0])
    within = ((query > corners.min(0)) & (query < corners.max(0))).all(-1)
    if within.any():  # outside of the box nothing is inside
        deep = _enclosed(query[within], distance[within], corners, triangles)
        distance[within] *= np.where(deep, -1, 1)
    return torch.from_numpy(distance).to(points)


def _enclosed(
    query: np.ndarray, distance: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """As `enclosed`: no surface lies between two positions that are nearer together than it."""
    cell = ((query - query.min(0)) / NEAR).astype(np.int64)
    row = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(0) + 1))
    _, first, group = np.unique(row, return_index=True, return_inverse=True)
    one = first[group]  # stands for its neighbours
    alone = np.linalg.norm(query - query[one], axis=1) >= np.maximum(distance, distance[one])
    alone[first] = True
    found = np.zeros(len(query), dtype=bool)
    found[alone] = enclosed(query[alone], verts, faces)
    return np.where(alone, found, found[one])


def outward(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces, turned over if they enclose a negative volume (as in a mirrored body)."""
    a, b, c = (verts[faces[:, k]] - verts[0] for k in range(3))
    return faces if (np.cross(a, b) * c).sum() >= 0 else faces[:, ::-1].copy()


def winding(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Winding number of the surface at integer places (x, y, z) below `shape`.

    Counts signed crossings along the y lines. Coordinates x and z are snapped to fixed point and
    the top-left rule decides ties, so that a line through a shared edge or vertex counts once. The
    vertices are in cells, whose centres have integer coordinates.
    """
    from mover.geometry.kernels.bodies import Body

    cross, (x, y, z) = kernels("bodies", "cpu").cross, shape.tolist()
    steps = torch.zeros(x, z, y + 1, dtype=torch.int32)
    body = filled(
        Body, faces=torch.from_numpy(faces.astype(np.int32)), place=torch.from_numpy(verts),
        size=started().vec3i(x, y, z), winding=steps,
    )  # fmt: skip
    launch(cross, len(faces), [body], steps.device)
    return steps[..., :-1].cumsum(2, dtype=torch.int32).transpose(1, 2).numpy()


def union_bodies(
    verts: Float[Tensor, "bodies verts 3"],
    faces: Int[Tensor, "faces 3"],
    grid: Volume,
    workers: int = 2,
    observe: Callable[[int, int], None] | None = None,
) -> Volume:
    """V = min over the bodies, and what `grid` holds, of the signed distance to each [m].

    Exact inside the bodies and up to two cells outside; further away as in `grid`. The result does
    not depend on the number of workers, and memory not on that of bodies, which are closed and
    wound outward or inward. `observe` is called with (bodies done, bodies) after each.

    Raises:
        ValueError: If a vertex is not finite.
    """
    if len(verts) == 0 or len(faces) == 0:
        return grid
    points = verts.detach().float().contiguous()
    kernels("bodies", name_of(verts.device))  # before there are threads
    corners = faces.to(verts.device, torch.int32).contiguous()
    count = min(max(1, workers), len(verts)) if verts.device.type == "cpu" else 1
    lock, done = Lock(), itertools.count(1)

    def lowered(part: Tensor) -> Tensor:
        """A volume of its own, lowered by some of the bodies."""
        mesh = _mesh(points[0], corners)
        field = grid.values.detach().float().to(verts.device).clone().contiguous()
        for body in part.tolist():
            if not bool(points[body].isfinite().all()):
                raise ValueError(f"union_bodies: body {body} has vertices that are not finite")
            add_body(points[body], corners, Volume(field, grid.origin, grid.cell), mesh)
            if observe is not None:
                with lock:
                    observe(next(done), len(verts))
        return field

    with ThreadPoolExecutor(count) as pool:
        fields = list(pool.map(lowered, torch.arange(len(verts)).chunk(count)))
    return replace(grid, values=torch.stack(fields).amin(0).to(grid.values))


def _mesh(verts: Tensor, corners: Tensor) -> Any:  # noqa: ANN401
    """Warp's mesh, whose vertices follow the bodies, without the triangles that have no area."""
    from mover.geometry.kernels.bodies import SLIVER

    a, b, c = verts[corners.long()].unbind(-2)
    square = torch.linalg.cross(b - a, c - a).square().sum(-1)
    flat = square <= SLIVER**2 * (b - a).square().sum(-1) * (c - a).square().sum(-1)
    some = corners if bool(flat.all()) else corners[~flat]
    wp = started()
    return wp.Mesh(wp.from_torch(verts.clone(), dtype=wp.vec3), wp.from_torch(some.flatten()))


def add_body(
    verts: Float[Tensor, "verts 3"],
    corners: Int[Tensor, "faces 3"],
    volume: Volume,
    mesh: Any,  # noqa: ANN401
) -> None:
    """Lower a volume, in place, to the signed distance of one body [m]."""
    from mover.geometry.kernels import bodies

    wp, device, reach = started(), verts.device, int(bodies.SHELL)
    place = (verts.double() - volume.origin.to(device).double()) / volume.cell
    last = torch.tensor(volume.values.shape) - 1
    low = (place.amin(0).floor().cpu().long() - reach).clamp_min(0)
    high = torch.minimum(place.amax(0).ceil().cpu().long() + reach, last)
    if bool((high < low).any()):
        return
    place = place - low.to(place)
    a, b, c = place[corners.long()].unbind(-2)
    side = 1 if float((torch.linalg.cross(a, b) * c).sum()) >= 0 else -1
    size = (high - low + 1).tolist()
    shape = size[0], size[2], size[1]
    body = filled(
        bodies.Body, faces=corners, place=place, low=wp.vec3i(*low.tolist()), size=wp.vec3i(*size),
        winding=torch.zeros(*shape[:2], shape[2] + 1, dtype=torch.int32, device=device),
        near=torch.full(shape, bodies.FAR, device=device),
    )  # fmt: skip
    wp.copy(mesh.points, wp.from_torch(place.float(), dtype=wp.vec3))
    mesh.refit()
    field = wp.from_torch(volume.values)
    launch(bodies.cross, len(corners), [body], device)
    launch(bodies.surround, len(corners), [body], device)
    launch(bodies.lower, shape[:2], [body, mesh.id, side, field, volume.cell], device)
