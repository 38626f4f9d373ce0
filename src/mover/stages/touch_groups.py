"""Which object each touching group of body parts touches (Sec. 3.1, "Contact constraint").

`vertex` (paper) decides for every vertex, `release` by the rules of `assign_release`, `group`
(robust) once for each body and group of parts, so that single wrong vertices have no say, and lets
only seats take a sitter and only other furniture a hand. A body's back touches what its seat
touches. Hands that rest in the air and backs that lean on nothing are the commonest false contacts
of bodies with a few degrees of pose error: they touch only what is within reach.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..bodies.parts import PARTS, Parts
from ..geometry.camera import project, to_camera
from ..geometry.placement import place
from ..records import record
from ..types import Bodies, Camera, Layout, Objects, People
from .assign_release import Candidates, decide_by_release
from .person_masks import mask_table
from .small import small_boxes, small_camera, small_masks

GROUPS = (
    ("seat", "left_thigh", "right_thigh"),
    ("back",),
    ("left_palm", "left_forearm"),
    ("right_palm", "right_forearm"),
)
FEWEST = 5  # vertices that a group must have to touch at all
RELEASE_GROUPS = (
    ("seat", "left_thigh", "right_thigh", "back"),
    ("left_palm", "right_palm", "left_forearm", "right_forearm"),
)
FAR_AWAY = 1e3  # [m], where padding goes


@dataclass(frozen=True)
class AssignConfig:
    """How contact vertices find their objects."""

    by: Literal["vertex", "group", "release"] = "vertex"
    """What is assigned as one."""
    split: Literal["normals", "parts"] = "normals"
    """Seat or back: by the normal of the vertex, or backs alone touch backs (unless they lie)."""
    chance: float = 0.5
    """A vertex touches from here on."""
    overlap: float = 0.5
    """Share of a group that must project into an object's mask."""
    farthest: float = 1.0
    """Farther than this from the object's part, nothing is touched [m]."""
    hand_reach: float = 1.0
    """The same for hands, and for backs of bodies that sit on no object (`group`) [m]."""
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
    people: People | None = None
    """Their masks (`release`)."""


@record
class ContactRows:
    """All touching vertices, one row each."""

    body: Int[Tensor, " rows"]
    vert: Int[Tensor, " rows"]
    object_of: Int[Tensor, " rows"]
    hand: Bool[Tensor, " rows"]


@record
class _Body:
    """One body in the image."""

    index: int
    points: Float[Tensor, "verts 3"]
    pixels: Int[Tensor, "verts 2"]
    mask: Bool[Tensor, "h w"] | None


@record
class _Group:
    """The touching vertices of one group of one body."""

    points: Float[Tensor, "verts 3"]
    pixels: Int[Tensor, "verts 2"]
    hands: bool
    lone_back: bool
    """A back whose body sits on no object."""
    seat: int
    """The object that a back has to lean on, as the body sits there; -1: any."""
    mask: Bool[Tensor, "h w"] | None


@record
class _Rivals:
    """The objects, as all groups are compared with them."""

    grown: Bool[Tensor, "objects h w"]
    """Masks, three pixels wider than detected; where there is none, the box."""
    tops: Float[Tensor, "objects region 3"]
    backs: Float[Tensor, "objects region 3"]
    plain: Candidates
    """For the rules of the release."""


def contact_rows(inputs: TouchInputs, config: AssignConfig) -> Iterator[ContactRows]:
    """All touching vertices with their objects, one group of one body at a time."""
    rivals = _rivals(inputs)
    groups = RELEASE_GROUPS if config.by == "release" else GROUPS
    members = [
        torch.isin(inputs.parts.part_of, torch.tensor([PARTS.index(n) for n in names]))
        for names in groups
    ]
    for body in _bodies(inputs, config):
        seat = -1
        for group, names in enumerate(groups):
            touching = inputs.probability[body.index] > config.chance
            verts = (members[group] & touching).nonzero()[:, 0]
            if len(verts) < FEWEST:
                continue
            hands, back = names[0].endswith("palm"), names == ("back",)
            part = _Group(
                body.points[verts], body.pixels[verts], hands, back and seat < 0,
                seat if back else -1, body.mask,
            )  # fmt: skip
            object_of = _decide(part, rivals, inputs.objects, config)
            if names[0] == "seat":
                seat = int(object_of.mode().values)
            found = object_of >= 0
            rows = torch.full_like(verts, body.index)
            hand = torch.full_like(found, hands)
            yield ContactRows(rows[found], verts[found], object_of[found], hand[found])


def _bodies(inputs: TouchInputs, config: AssignConfig) -> Iterator[_Body]:
    camera, bodies = small_camera(inputs.camera), inputs.bodies
    table = None
    if config.by == "release" and inputs.people is not None:
        table = mask_table(inputs.people, bodies)
    for index, points in enumerate(bodies.verts):  # one at a time: memory stays that of one
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        mask = None
        if table is not None and table.own[index] is not None:
            mask = small_masks(table.decode(index)[0].unsqueeze(0), inputs.camera)[0]
        yield _Body(index, points, pixels, mask)


def _rivals(inputs: TouchInputs) -> _Rivals:
    objects, layout = inputs.objects, inputs.layout
    boxes = small_boxes(inputs.boxes, inputs.camera)
    masks = _filled(small_masks(inputs.masks, inputs.camera), boxes)
    grown = torch.nn.functional.max_pool2d(masks.float().unsqueeze(1), 7, 1, 3).squeeze(1) > 0
    verts = place(objects.verts, layout)
    far_away = torch.full_like(verts, FAR_AWAY)
    verts = torch.where(objects.real_verts.unsqueeze(-1), verts, far_away)
    plain = Candidates(objects.categories, masks, boxes, verts)
    return _Rivals(grown, place(objects.top, layout), place(objects.back, layout), plain)


def _decide(
    part: _Group, rivals: _Rivals, objects: Objects, config: AssignConfig
) -> Int[Tensor, " verts"]:
    """Index of the object that each vertex touches, -1 for none."""
    if config.by == "release":
        one = decide_by_release(part.points, part.pixels, part.mask, rivals.plain, arms=part.hands)
        return torch.full_like(part.pixels[:, 0], one)
    over = _inside(rivals.grown, part.pixels)
    ways = [_distances(part.points, r) for r in (rivals.tops, rivals.backs)]
    away, may = torch.stack(ways).amin(0), _may(objects, hands=part.hands)
    if config.by == "vertex":
        price = torch.where(over & may.unsqueeze(-1), away, torch.full_like(away, torch.inf))
        lowest, best = price.min(0)
        return torch.where(lowest < config.farthest, best, torch.full_like(best, -1))
    if part.seat >= 0:
        may = may & (torch.arange(len(may)) == part.seat)
    near = config.hand_reach if part.hands or part.lone_back else config.farthest
    share, distance = over.float().mean(-1), away.mean(-1)
    fits = may & (share >= config.overlap) & (distance < near)
    score = torch.where(fits, share - distance, torch.full_like(share, -torch.inf))
    best = score.argmax() if fits.any() else torch.tensor(-1)
    return best.expand(over.shape[1])


def _may(objects: Objects, *, hands: bool) -> Bool[Tensor, " objects"]:
    """Seats take sitters and backs, other tops take hands."""
    return objects.has_top & ~objects.is_seat if hands else objects.is_seat


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
