"""The space that bodies have moved through: the union of bodies by Warp kernels.

Signed crossings give the winding numbers, Warp's mesh the distances. A launch on the CPU is serial
but releases Python's lock, so bodies are measured in threads, each with a volume of its own; the
minimum of these is the result.
"""

import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Lock
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.volume import Volume
from mover.geometry.warp_start import array, kernels, launch, name_of, started

REACH = 2  # [cells], that the shell reaches out of the body
SLIVER = 1e-9  # squared sine of an angle below which a triangle has no area


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
    a, b, c = verts[corners.long()].unbind(-2)
    square = torch.linalg.cross(b - a, c - a).square().sum(-1)
    flat = square <= SLIVER * (b - a).square().sum(-1) * (c - a).square().sum(-1)
    some = corners if bool(flat.all()) else corners[~flat]
    return started().Mesh(array(verts.clone(), "vec3"), array(some.flatten(), "int32"))


def add_body(
    verts: Float[Tensor, "verts 3"],
    corners: Int[Tensor, "faces 3"],
    volume: Volume,
    mesh: Any,  # noqa: ANN401
) -> None:
    """Lower a volume, in place, to the signed distance of one body [m]."""
    from mover.geometry.kernels import bodies

    wp, device = started(), verts.device
    place = (verts.double() - volume.origin.to(device).double()) / volume.cell
    last = torch.tensor(volume.values.shape) - 1
    low = (place.amin(0).floor().cpu().long() - REACH).clamp_min(0)
    high = torch.minimum(place.amax(0).ceil().cpu().long() + REACH, last)
    if bool((high < low).any()):
        return
    place = place - low.to(place)
    a, b, c = place[corners.long()].unbind(-2)
    side = 1 if float((torch.linalg.cross(a, b) * c).sum()) >= 0 else -1
    size = (high - low + 1).tolist()
    shape = size[0], size[2], size[1]
    body = bodies.Body()
    body.faces, body.place = array(corners, "vec3i"), array(place, "vec3d")
    body.low, body.size = wp.vec3i(*low.tolist()), wp.vec3i(*size)
    steps = torch.zeros(*shape[:2], shape[2] + 1, dtype=torch.int32, device=device)
    body.winding = array(steps, "int32")
    at = place.float()
    wp.copy(mesh.points, array(at, "vec3"))
    mesh.refit()
    field = array(volume.values, "float32")
    launch(bodies.cross, len(corners), [body], device)
    launch(bodies.lower, shape[:2], [body, mesh.id, side, field, volume.cell], device)
