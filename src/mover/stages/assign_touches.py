"""Find the object that each touching body part touches (Sec. 3.1, "Contact constraint").

By the overlap of its projection with the objects' masks and by the distance in 3D. `vertex` (paper)
decides for every vertex; `group` decides once for each body and group of parts (seat with thighs,
back, left hand, right hand), so that single wrong vertices have no say, and lets only seats take a
sitter and only other furniture a hand.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..bodies.parts import PARTS, Parts
from ..bodies.touch import headings, postures
from ..geometry.camera import project, to_camera
from ..geometry.mesh import vertex_normals
from ..geometry.placement import place
from ..minimize import Observer, silent
from ..records import record
from ..terms.contact import Touches
from ..types import Bodies, Camera, Layout, Objects
from .small import small_boxes, small_camera, small_masks
from .thin_points import thin

GROUPS = (
    ("seat", "left_thigh", "right_thigh"),
    ("back",),
    ("left_palm", "left_forearm"),
    ("right_palm", "right_forearm"),
)
FEWEST = 5  # vertices that a group must have to touch at all
LEVEL = 0.7071  # cosine of 45 degrees, the released code's split of the normals


@dataclass(frozen=True)
class AssignConfig:
    """How contact vertices find their objects."""

    by: Literal["vertex", "group"] = "vertex"
    """What is assigned as one."""
    split: Literal["normals", "parts"] = "normals"
    """Seat or back: by the normal of the vertex, or backs alone touch backs (unless they lie)."""
    chance: float = 0.5
    """A vertex touches from here on."""
    overlap: float = 0.5
    """Share of a group that must project into an object's mask."""
    farthest: float = 1.0
    """Farther than this from the object's part, nothing is touched [m]."""
    cell: float = 0.01
    """Contact points nearer than this become one with their count as weight [m]."""
    most: int = 2000
    """Points kept for each part of each object."""


@record
class TouchInputs:
    """Bodies in the world and the objects in the image."""

    bodies: Bodies
    probability: Float[Tensor, "bodies verts"]
    parts: Parts
    masks: Bool[Tensor, "objects h w"]
    boxes: Float[Tensor, "objects 4"]
    """Used where an object has no mask [px]."""
    camera: Camera
    objects: Objects
    layout: Layout


@record
class _Contacts:
    """All touching vertices, one row each."""

    body: Int[Tensor, " rows"]
    vert: Int[Tensor, " rows"]
    object_of: Int[Tensor, " rows"]
    hand: Bool[Tensor, " rows"]


@record
class Contacts:
    """Who touches what."""

    touches: Touches | None
    """Contact points of each object; None: nothing is touched."""
    seated_on: Bool[Tensor, " bodies"]
    """Bodies whose seat or back touches an object."""
    touched_in: tuple[int, ...]
    """Number of bodies that touch each object."""


def assign_touches(
    inputs: TouchInputs, config: AssignConfig, observe: Observer = silent
) -> Contacts:
    """Give each touching part of each body to the object that it touches."""
    del observe
    found = [c for c in _contacts(inputs, config) if len(c.body)]
    seated = torch.zeros(len(inputs.bodies.frame), dtype=torch.bool)
    counts = [0] * len(inputs.objects.ids)
    if not found:
        return Contacts(None, seated, tuple(counts))
    names = ("body", "vert", "object_of", "hand")
    rows = _Contacts(*(torch.cat([getattr(c, n) for c in found]) for n in names))
    seated[rows.body[~rows.hand]] = True
    touches = _pack(rows, inputs, config)
    for i, bodies in zip(touches.object_of.tolist(), touches.bodies.tolist(), strict=True):
        counts[i] = int(bodies)
    return Contacts(touches, seated, tuple(counts))


def _contacts(inputs: TouchInputs, config: AssignConfig) -> Iterator[_Contacts]:
    camera = small_camera(inputs.camera)
    boxes = small_boxes(inputs.boxes, inputs.camera)
    masks = _filled(small_masks(inputs.masks, inputs.camera), boxes)
    grown = torch.nn.functional.max_pool2d(masks.float().unsqueeze(1), 7, 1, 3).squeeze(1) > 0
    regions = place(inputs.objects.top, inputs.layout), place(inputs.objects.back, inputs.layout)
    for body in range(len(inputs.bodies.frame)):  # one body at a time: memory stays that of one
        points = inputs.bodies.verts[body]
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        for group, names in enumerate(GROUPS):
            mine = torch.isin(inputs.parts.part_of, torch.tensor([PARTS.index(n) for n in names]))
            verts = (mine & (inputs.probability[body] > config.chance)).nonzero()[:, 0]
            if len(verts) < FEWEST:
                continue
            over = _inside(grown, pixels[verts])
            away = torch.stack([_distances(points[verts], r) for r in regions]).amin(0)
            object_of = _decide(over, away, _may(inputs.objects, group), config)
            touched = object_of >= 0
            rows = torch.full_like(verts, body)
            hand = torch.full_like(touched, group >= 2)
            yield _Contacts(rows[touched], verts[touched], object_of[touched], hand[touched])


def _may(objects: Objects, group: int) -> Bool[Tensor, " objects"]:
    """Who can take this group: seats take sitters and backs, other tops take hands."""
    if group >= 2:
        return objects.has_top & ~objects.is_seat
    return objects.is_seat


def _decide(
    over: Bool[Tensor, "objects verts"],
    away: Float[Tensor, "objects verts"],
    may: Bool[Tensor, " objects"],
    config: AssignConfig,
) -> Int[Tensor, " verts"]:
    """Index of the object that each vertex touches, -1 for none."""
    if config.by == "vertex":
        price = torch.where(over & may.unsqueeze(-1), away, torch.full_like(away, float("inf")))
        lowest, best = price.min(0)
        return torch.where(lowest < config.farthest, best, torch.full_like(best, -1))
    share, distance = over.float().mean(-1), away.mean(-1)
    fits = may & (share >= config.overlap) & (distance < config.farthest)
    score = torch.where(fits, share - distance, torch.full_like(share, float("-inf")))
    best = score.argmax() if fits.any() else torch.tensor(-1)
    return best.expand(over.shape[1])


def _inside(masks: Bool[Tensor, "objects h w"], pixels: Int[Tensor, "verts 2"]) -> Tensor:
    height, width = masks.shape[-2:]
    x, y = pixels.unbind(-1)
    shown = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return masks[:, y.clamp(0, height - 1), x.clamp(0, width - 1)] & shown


def _filled(masks: Bool[Tensor, "objects h w"], boxes: Float[Tensor, "objects 4"]) -> Tensor:
    """Masks; where an object has none, its box."""
    height, width = masks.shape[-2:]
    y, x = torch.arange(height)[:, None] + 0.5, torch.arange(width) + 0.5
    low, high = boxes[:, :2, None, None], boxes[:, 2:, None, None]
    inside = (x > low[:, 0]) & (x < high[:, 0]) & (y > low[:, 1]) & (y < high[:, 1])
    known = masks.any(-1).any(-1)[:, None, None]
    return torch.where(known, masks, inside)


def _distances(
    points: Float[Tensor, "verts 3"], region: Float[Tensor, "objects region 3"]
) -> Tensor:
    """Distance of each vertex from each object's part, through at most 40 of the vertices [m]."""
    some = points[:: max(1, len(points) // 40)]
    away = torch.cdist(some, region).amin(-1)  # objects some
    nearest = torch.cdist(points, some).argmin(-1)
    return away[:, nearest]


def _pack(rows: _Contacts, inputs: TouchInputs, config: AssignConfig) -> Touches:
    normals = vertex_normals(inputs.bodies.verts, inputs.bodies.faces)[rows.body, rows.vert]
    points = inputs.bodies.verts[rows.body, rows.vert]
    level = normals[:, 1].abs() >= LEVEL
    if config.split == "parts":
        level = level | (inputs.parts.part_of[rows.vert] != PARTS.index("back"))
    touched = rows.object_of.unique()
    packed, weight = thin(
        points,
        torch.searchsorted(touched, rows.object_of) * 4 + (~level).long() + 2 * rows.hand.long(),
        4 * len(touched),
        (config.cell, config.most),
    )
    back = inputs.objects.has_back[touched].float()
    usable = torch.stack([torch.ones_like(back), back, torch.ones_like(back), back], -1)
    weight = weight.unflatten(0, (len(touched), 4)) * usable.unsqueeze(-1)
    bodies = [len(rows.body[rows.object_of == o].unique()) for o in touched.tolist()]
    return Touches(
        touched, packed.unflatten(0, (len(touched), 4)), weight,
        torch.tensor(bodies, dtype=points.dtype), _headings(rows, touched, inputs),
    )  # fmt: skip


def _headings(rows: _Contacts, touched: Int[Tensor, " touched"], inputs: TouchInputs) -> Tensor:
    """Mean horizontal direction of those who sit on each touched object; zero for none."""
    facing = headings(inputs.bodies, inputs.parts)[:, [0, 2]]
    sits = postures(inputs.bodies, inputs.parts).sitting
    means: list[Tensor] = []
    for o in touched.tolist():
        seated = rows.body[(rows.object_of == o) & ~rows.hand].unique()
        mean = facing[seated[sits[seated]]].sum(0)
        means.append(mean / mean.norm().clamp_min(1e-9) if mean.norm() > 0.1 else 0 * mean)
    return torch.stack(means)
