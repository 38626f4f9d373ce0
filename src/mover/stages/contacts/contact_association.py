"""Which object each touching group of body parts touches (Sec. 3.1, "Contact constraint").

`mask_hits` (paper) decides by the rules of the authors' released code (`decide_by_mask_hits`),
`group` (robust) once for each body and group of parts, so that single wrong vertices have no
weight, and lets only seats take a sitter and only other furniture a hand. A body's back touches
what its seat touches. Hands that rest in the air and backs that lean on nothing are the commonest
false contacts of bodies with a few degrees of pose error: they touch only what is within reach.
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import BodyParts
from mover.bodies.skin import PARTS
from mover.core.records import record
from mover.core.types import Bodies, Camera, Layout, Objects, People
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.placement import place
from mover.stages.config import AssignConfig
from mover.stages.contacts.mask_hits import Candidates, decide_by_mask_hits
from mover.stages.masks import mask_table, small_boxes, small_camera, small_masks

GROUPS = (
    ("seat", "left_thigh", "right_thigh"),
    ("back",),
    ("left_palm", "left_forearm"),
    ("right_palm", "right_forearm"),
)
MASK_HIT_GROUPS = (
    ("seat", "left_thigh", "right_thigh", "back"),
    ("left_palm", "right_palm", "left_forearm", "right_forearm"),
)
CHANCE = 0.5  # a vertex touches from here on
FEWEST = 5  # vertices that a group must have to touch at all
OVERLAP = 0.5  # share of a group that must project into an object's mask
FARTHEST = 1.0  # [m] from the object's part, at most (authors' code)
HAND_REACH = 0.25  # [m], the same for hands, and for backs of bodies that sit on no object
FAR_AWAY = 1e3  # [m], where padding goes


@record
class AssignInputs:
    """Bodies in the world and the objects in the image."""

    bodies: Bodies
    probability: Float[Tensor, "bodies verts"]
    parts: BodyParts
    masks: Bool[Tensor, "objects h w"]
    boxes: Float[Tensor, "objects 4"]
    """Used where an object has no mask [px]."""
    camera: Camera
    objects: Objects
    layout: Layout
    people: People | None = None
    """Their masks (`mask_hits`)."""


@record
class ContactRows:
    """Touching vertices, one row each."""

    body: Int[Tensor, " rows"]
    vert: Int[Tensor, " rows"]
    object_of: Int[Tensor, " rows"]
    hand: Bool[Tensor, " rows"]


def contact_rows(inputs: AssignInputs, config: AssignConfig) -> Iterator[ContactRows]:
    """All touching vertices with their objects, one group of one body at a time."""
    by_hits, bodies, camera = config.by == "mask_hits", inputs.bodies, small_camera(inputs.camera)
    groups = MASK_HIT_GROUPS if by_hits else GROUPS
    members = [
        torch.isin(inputs.parts.part_of, torch.tensor([PARTS.index(n) for n in names]))
        for names in groups
    ]
    touching = inputs.probability > CHANCE
    enough = torch.stack([(touching & mine).sum(1) >= FEWEST for mine in members], 1)
    candidates, surfaces = _candidates(inputs), _touchable(inputs)
    table = mask_table(inputs.people, bodies) if by_hits and inputs.people is not None else None
    for index in enough.any(1).nonzero()[:, 0].tolist():  # memory stays that of one body
        points, person, seat = bodies.verts[index], None, -1
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        if table is not None and table.own[index] is not None:
            person = small_masks(table.decode(index)[0].unsqueeze(0), inputs.camera)[0]
        for group in enough[index].nonzero()[:, 0].tolist():
            names, verts = groups[group], (members[group] & touching[index]).nonzero()[:, 0]
            skin, hands = (points[verts], pixels[verts]), names[0].endswith("palm")
            if by_hits:
                touched = decide_by_mask_hits(*skin, person, candidates, arms=hands)
            else:
                touched = surfaces.touched(*skin, names, seat)
            if names[0] == "seat":
                seat = touched
            if touched >= 0:
                rows = (torch.full_like(verts, value) for value in (index, touched))
                body, object_of = rows
                yield ContactRows(body, verts, object_of, torch.full_like(verts, hands).bool())


def _candidates(inputs: AssignInputs) -> Candidates:
    """The objects for `decide_by_mask_hits`; an object without a mask has its box."""
    objects, boxes = inputs.objects, small_boxes(inputs.boxes, inputs.camera)
    masks = _filled(small_masks(inputs.masks, inputs.camera), boxes)
    verts = place(objects.verts, inputs.layout)
    verts = torch.where(objects.real_verts.unsqueeze(-1), verts, torch.full_like(verts, FAR_AWAY))
    return Candidates(objects.categories, masks, boxes, verts)


@record
class _Touchable:
    """What groups of parts can touch (`group`)."""

    objects: Objects
    grown: Bool[Tensor, "objects h w"]
    """Masks, three pixels wider than detected; where there is none, the box."""
    tops: Float[Tensor, "objects region 3"]
    backs: Float[Tensor, "objects region 3"]

    def touched(
        self,
        points: Float[Tensor, "verts 3"],
        pixels: Int[Tensor, "verts 2"],
        names: tuple[str, ...],
        seat: int,
    ) -> int:
        """Index of the object that a group touches, -1 for none.

        Args:
            points: Its touching vertices in the world [m].
            pixels: Where they are seen.
            names: The parts of the group.
            seat: What the body sits on; -1: no object.
        """
        objects, hands, back = self.objects, names[0].endswith("palm"), names == ("back",)
        may = objects.has_top & ~objects.is_seat if hands else objects.is_seat
        if back and seat >= 0:
            may = may & (torch.arange(len(may)) == seat)
        grown, shown = at_pixels(self.grown, pixels)
        share = (grown & shown).float().mean(-1)
        able = (may & (share >= OVERLAP)).nonzero()[:, 0]
        if not len(able):
            return -1
        distance = _distances(points, self.tops[able], self.backs[able]).mean(-1)
        near = HAND_REACH if hands or (back and seat < 0) else FARTHEST
        score = torch.where(distance < near, share[able] - distance, -torch.inf)
        return int(able[score.argmax()]) if bool(score.isfinite().any()) else -1


def _touchable(inputs: AssignInputs) -> _Touchable:
    objects, layout, boxes = inputs.objects, inputs.layout, small_boxes(inputs.boxes, inputs.camera)
    masks = _filled(small_masks(inputs.masks, inputs.camera), boxes)
    down = torch.nn.functional.max_pool2d(masks.float().unsqueeze(1), (7, 1), 1, (3, 0))
    grown = torch.nn.functional.max_pool2d(down, (1, 7), 1, (0, 3)).squeeze(1) > 0
    return _Touchable(objects, grown, place(objects.top, layout), place(objects.back, layout))


def _filled(masks: Bool[Tensor, "objects h w"], boxes: Float[Tensor, "objects 4"]) -> Tensor:
    """Masks; where an object has none, its box."""
    height, width = masks.shape[-2:]
    y, x = torch.arange(height)[:, None] + 0.5, torch.arange(width) + 0.5
    low, high = boxes[:, :2, None, None], boxes[:, 2:, None, None]
    inside = (x > low[:, 0]) & (x < high[:, 0]) & (y > low[:, 1]) & (y < high[:, 1])
    known = masks.any(-1).any(-1)[:, None, None]
    return torch.where(known, masks, inside)


def _distances(
    points: Float[Tensor, "verts 3"],
    tops: Float[Tensor, "objects region 3"],
    backs: Float[Tensor, "objects region 3"],
) -> Float[Tensor, "objects verts"]:
    """Distance of each vertex from each object's parts, through at most 40 of the vertices [m]."""
    some = points[:: max(1, len(points) // 40)]
    ways = [torch.cdist(some, region).amin(-1) for region in (tops, backs)]
    nearest = torch.cdist(points, some).argmin(-1)
    return torch.minimum(*ways)[:, nearest]
