"""Label the contacts of a finished room: part of the body, object, position, normal, confidence.

Two cues agree or not: how near the part comes to the surface, and whether the posture bears on
something (as in `find_contacts`: sitting, leaning, hands and soles at rest). The label keeps the
product, with a lower bound on the second, as no posture shows a shin against a table.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from mover.bodies.parts import PARTS, BodyParts, members
from mover.bodies.posture import touching
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Bodies, ContactLabels, Mesh
from mover.geometry.nearest import as_float64, as_int64, closest, enclosed
from mover.geometry.placement import StandingMesh
from mover.geometry.volume import outward
from mover.stages.contacts.assign_contacts import evenly

FLOOR = "ground"
NEAR = 0.02  # [m], up to here the part surely touches
UNSEEN = 0.4  # share of the confidence that nearness alone gives, where no posture supports it
REACH = 0.06  # [m], from here on nothing touches: what bodies of single frames float on average
LEAST = 0.2  # labels below this confidence are left out
MOST = 40  # vertices of a part that are measured, evenly chosen


@record
class LabelInputs:
    """A finished room."""

    bodies: Bodies
    """In the world."""
    parts: BodyParts
    meshes: tuple[tuple[StandingMesh, ...], ...]
    """Closed, of each object where it stands when."""
    ids: tuple[str, ...]
    ground: float | None


@record
class _SurfacePoints:
    """The nearest points of one surface to some vertices of all bodies."""

    gap: Float[Tensor, "bodies verts"]
    """Negative inside [m]; inf: out of reach."""
    position: Float[Tensor, "bodies verts 3"]
    normal: Float[Tensor, "bodies verts 3"]


def label_contacts(
    inputs: LabelInputs, _config: None = None, _observe: Observer = silent
) -> ContactLabels:
    """The labels of all frames, in the order of parts, objects, rows."""
    bodies = inputs.bodies
    ground = float(bodies.verts[..., 1].amin()) if inputs.ground is None else inputs.ground
    chance = touching(bodies, inputs.parts, ground)
    known = [members(inputs.parts, name) for name in PARTS]
    sure = torch.stack([(chance * mine).amax(1) for mine in known], 1)
    chosen = [evenly(mine.nonzero()[:, 0], MOST) for mine in known]
    part_of = torch.cat([torch.full_like(verts, part) for part, verts in enumerate(chosen)])
    points = bodies.verts[:, torch.cat(chosen)]
    none, flat = torch.zeros(0, dtype=torch.long), points.new_zeros(0, 3)
    found: list[tuple[Tensor, ...]] = [(none, none, none, flat[:, 0], flat, flat)]
    for k, surface in _surfaces(points, inputs):
        for number in part_of.unique().tolist():
            row, *touch = _touches(surface, part_of == number)
            found.append((torch.full_like(row, number), torch.full_like(row, k), row, *touch))
    columns = (torch.cat(column) for column in zip(*found, strict=True))
    part, of, row, gap, position, normal = columns
    close = ((gap - REACH) / (NEAR - REACH)).clamp(0, 1)
    confidence = close * (UNSEEN + (1 - UNSEEN) * sure[row, part])
    order = part.argsort(stable=True)
    order = order[confidence[order] >= LEAST]
    return ContactLabels(
        frame=bodies.frame[row[order]], person=bodies.person[row[order]], part=part[order],
        object=of[order], position=position[order], normal=normal[order], gap=gap[order],
        confidence=confidence[order], parts=PARTS, objects=(*inputs.ids, FLOOR),
    )  # fmt: skip


def _surfaces(
    points: Float[Tensor, "bodies verts 3"], inputs: LabelInputs
) -> Iterator[tuple[int, _SurfacePoints]]:
    """Each object where it stands, and the floor; one at a time: memory stays that of one."""
    for k, stands in enumerate(inputs.meshes):
        for there in stands:
            now = there.when(inputs.bodies.frame)
            yield k, _solid(points, there.mesh, now)
    if inputs.ground is not None:
        below, up = points.clone(), torch.zeros_like(points)
        below[..., 1], up[..., 1] = inputs.ground, 1.0
        yield len(inputs.meshes), _SurfacePoints(points[..., 1] - inputs.ground, below, up)


def _solid(
    points: Float[Tensor, "bodies verts 3"], mesh: Mesh, now: Bool[Tensor, " bodies"]
) -> _SurfacePoints:
    verts = as_float64(mesh.verts)
    faces = outward(verts, as_int64(mesh.faces))
    low, high = mesh.verts.amin(0) - REACH, mesh.verts.amax(0) + REACH
    near = (torch.minimum(points - low, high - points).amin(-1) > 0) & now[:, None]
    gap, position = torch.full_like(points[..., 0], torch.inf), torch.zeros_like(points)
    normal = torch.zeros_like(points)
    if bool(near.any()):
        query = as_float64(points[near])
        squared, face, nearest = closest(query, verts, faces)
        inside = enclosed(query, verts, faces)
        corners = torch.from_numpy(verts[faces[face]])
        across = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        gap[near] = torch.from_numpy(np.where(inside, -1, 1) * np.sqrt(squared)).to(gap)
        position[near] = torch.from_numpy(nearest).to(position)
        normal[near] = normalize(across, dim=-1).to(normal)
    return _SurfacePoints(gap, position, normal)


def _touches(
    surface: _SurfacePoints, part: Bool[Tensor, " verts"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Bodies whose part is near, its gap, position and normal: means over its nearest points."""
    gap = surface.gap[:, part].amin(1)
    row = (gap < REACH).nonzero()[:, 0]
    each, gap, normal = surface.gap[row][:, part], gap[row], surface.normal[row][:, part]
    layer = (each <= gap[:, None].clamp_min(0) + NEAR / 2).to(normal)[..., None]
    share = layer / layer.sum(1, keepdim=True)
    mean = (share * normal).sum(1)
    best = normal[torch.arange(len(row)), each.argmin(1)]
    unit = torch.where(mean.norm(dim=-1, keepdim=True) > 0.5, mean, best)
    position = (share * surface.position[row][:, part]).sum(1)
    return row, gap, position, normalize(unit, dim=-1)
