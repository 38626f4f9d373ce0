"""Label the contacts of a finished room: part of the body, object, place, normal, confidence.

Two cues agree or not: how near the part comes to the surface (`closeness`), and whether the posture
says that it bears on something (`chance`, as in `find_contacts`: sitting, leaning, hands and soles
at rest). The label keeps the product, with a floor under the second, as no posture tells of a shin
against a table.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts, members
from mover.bodies.posture import touching
from mover.bodies.skin import PARTS
from mover.core.contact_labels import ContactLabels
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.settings import Count, Metres, Share
from mover.core.types import Bodies, Mesh
from mover.geometry.nearest import as_float64, as_int64, closest, enclosed
from mover.geometry.placement import StandingMesh
from mover.geometry.volume import outward

FLOOR = "ground"


@dataclass(frozen=True)
class LabelConfig:
    """What counts as a touch."""

    reach: Metres = 0.06
    """From here on nothing touches [m]: what bodies of single frames float on average."""
    near: Metres = 0.02
    """Up to here the part surely touches [m]."""
    unseen: Share = 0.4
    """Share of the confidence that nearness alone gives, where the posture says nothing."""
    least: Share = 0.2
    """Labels below this confidence are left out."""
    most: Count = 40
    """Vertices of a part that are looked at, evenly chosen."""


@record
class LabelInputs:
    """A finished room."""

    bodies: Bodies
    """In the world."""
    parts: Parts
    meshes: tuple[tuple[StandingMesh, ...], ...]
    """Closed, of each object where it stands when."""
    ids: tuple[str, ...]
    ground: float | None


@record
class _Touches:
    """Rows of bodies whose part is near one surface."""

    row: Int[Tensor, " rows"]
    gap: Float[Tensor, " rows"]
    position: Float[Tensor, "rows 3"]
    normal: Float[Tensor, "rows 3"]


def label_contacts(
    inputs: LabelInputs, config: LabelConfig, observe: Observer = silent
) -> ContactLabels:
    """The labels of all frames, in the order of parts, objects, rows."""
    del observe
    bodies, parts = inputs.bodies, inputs.parts
    ground = float(bodies.verts[..., 1].amin()) if inputs.ground is None else inputs.ground
    chance = touching(bodies, parts, ground)
    known = [members(parts, name) for name in PARTS]
    named = [part for part, mine in enumerate(known) if bool(mine.any())]
    chosen = [_evenly(known[part].nonzero()[:, 0], config.most) for part in named]
    points = [bodies.verts[:, verts] for verts in chosen]
    surfaces = [
        (k, _near_solid(points, there.mesh, there.when(bodies.frame), config))
        for k, stands in enumerate(inputs.meshes)
        for there in stands
    ]
    if inputs.ground is not None:
        floors = [_near_floor(some, inputs.ground, config) for some in points]
        surfaces.append((len(inputs.meshes), floors))
    found: list[tuple[int, int, _Touches, Tensor]] = []
    for number, part in enumerate(named):
        sure = chance[:, known[part]].amax(1)
        for k, touch in ((k, touches[number]) for k, touches in surfaces):
            close = (touch.gap - config.reach) / (config.near - config.reach)
            trust = config.unseen + (1 - config.unseen) * sure[touch.row]
            found.append((part, k, touch, close.clamp(0, 1) * trust))
    return _joined(found, inputs, config)


def _evenly(verts: Int[Tensor, " verts"], most: int) -> Int[Tensor, " some"]:
    return verts[torch.linspace(0, len(verts) - 1, min(most, len(verts))).round().long()]


def _near_solid(
    parts: list[Float[Tensor, "bodies points 3"]],
    mesh: Mesh,
    now: Bool[Tensor, " bodies"],
    config: LabelConfig,
) -> list[_Touches]:
    """Bodies of now whose points come near an object, for each part: all are asked for at once."""
    verts = as_float64(mesh.verts)
    faces = outward(verts, as_int64(mesh.faces))
    low, high = (torch.from_numpy(end) for end in (verts.min(0), verts.max(0)))
    low, high = (end.to(mesh.verts) for end in (low - config.reach, high + config.reach))
    near = (torch.minimum(points - low, high - points).amin(-1) > 0 for points in parts)
    inside = [some & now[:, None] for some in near]
    counts = [int(some.sum()) for some in inside]
    if not any(counts):
        return [_touches(points, torch.zeros(0).long(), []) for points in parts]
    query = as_float64(torch.cat([p[some] for p, some in zip(parts, inside, strict=True)]))
    squared, face, nearest = closest(query, verts, faces)
    away = np.sqrt(squared)
    gaps = np.where(enclosed(query, verts, faces, away), -1, 1) * away
    ends = np.cumsum(counts)[:-1]
    values = [np.split(x, ends) for x in (gaps, nearest, _normals(verts, faces)[face])]
    found: list[_Touches] = []
    for points, some, *mine in zip(parts, inside, *values, strict=True):
        row = some.any(-1).nonzero()[:, 0]
        asked = some[row].numpy()
        empty = np.full(asked.shape, np.inf), *(np.zeros((*asked.shape, 3)) for _ in range(2))
        for whole, few in zip(empty, mine, strict=True):
            whole[asked] = few
        found.append(_touches(points, row, list(empty), config))
    return found


def _normals(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals of faces."""
    corners = verts[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _near_floor(
    points: Float[Tensor, "bodies points 3"], ground: float, config: LabelConfig
) -> _Touches:
    """Bodies whose points come near the floor."""
    height = points[..., 1] - ground
    row = (height.amin(1) < config.reach).nonzero()[:, 0]
    place = points[row].clone()
    place[..., 1] = ground
    up = torch.zeros_like(place)
    up[..., 1] = 1.0
    values = [height[row].double().numpy(), place.numpy(), up.numpy()]
    return _touches(points, row, values, config)


def _touches(
    points: Float[Tensor, "bodies points 3"],
    row: Int[Tensor, " rows"],
    values: list[np.ndarray],
    config: LabelConfig | None = None,
) -> _Touches:
    """The part's place on the surface: the mean over its points that are nearest."""
    if not values or config is None:
        nothing = points.new_zeros(0, 3)
        return _Touches(row, points.new_zeros(0), nothing, nothing)
    signed, place, normal = (torch.from_numpy(value).to(points) for value in values)
    gap = signed.amin(1)
    keep = gap < config.reach
    layer = (signed <= gap[:, None].clamp_min(0) + config.near / 2)[keep].to(points)[..., None]
    share = layer / layer.sum(1, keepdim=True)
    mean = (share * normal[keep]).sum(1)
    best = normal[keep][torch.arange(int(keep.sum())), signed[keep].argmin(1)]
    unit = torch.where(mean.norm(dim=-1, keepdim=True) > 0.5, mean, best)
    unit = unit / unit.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return _Touches(row[keep], gap[keep], (share * place[keep]).sum(1), unit)


def _joined(
    found: list[tuple[int, int, _Touches, Tensor]], inputs: LabelInputs, config: LabelConfig
) -> ContactLabels:
    bodies = inputs.bodies
    nothing = _Touches(
        torch.zeros(0, dtype=torch.long), torch.zeros(0), torch.zeros(0, 3), torch.zeros(0, 3)
    )
    rows = [*found, (0, 0, nothing, torch.zeros(0))]
    keep = torch.cat([sure >= config.least for *_, sure in rows])
    body = torch.cat([touch.row for _, _, touch, _ in rows])[keep]
    return ContactLabels(
        frame=bodies.frame[body],
        person=bodies.person[body],
        part=torch.cat([torch.full_like(t.row, part) for part, _, t, _ in rows])[keep],
        object=torch.cat([torch.full_like(t.row, k) for _, k, t, _ in rows])[keep],
        position=torch.cat([t.position for _, _, t, _ in rows])[keep],
        normal=torch.cat([t.normal for _, _, t, _ in rows])[keep],
        gap=torch.cat([t.gap for _, _, t, _ in rows])[keep],
        confidence=torch.cat([sure for *_, sure in rows])[keep],
        parts=PARTS,
        objects=(*inputs.ids, FLOOR),
    )
