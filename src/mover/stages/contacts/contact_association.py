"""Which object each touching group of body parts touches (Sec. 3.1, "Contact constraint").

`vertex` decides for every vertex, `mask_hits` (paper) by the rules of the authors' released code
(`decide_by_mask_hits`), `group` (robust) once for each body and group of parts, so that single
wrong vertices have no say, and lets only seats take a sitter and only other furniture a hand. A
body's back touches what its seat touches. Hands that rest in the air and backs that lean on nothing
are the commonest false contacts of bodies with a few degrees of pose error: they touch only what is
within reach.
"""

from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts
from mover.bodies.skin import PARTS
from mover.core.records import record
from mover.core.types import Bodies, Camera, Layout, Objects, People
from mover.geometry.boxes import iou2d
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.placement import place
from mover.stages.config import AssignConfig
from mover.stages.masks import mask_table, small_boxes, small_camera, small_masks

# Which object a group of contact vertices touches, by the rules of the authors' released code.
#
# The whole body (seat, thighs, back) and both arms (hands, forearms) are each given to one object:
#
# 1. An object is a candidate if its mask shares a pixel with the person's mask and its box overlaps
#    the person's box; arms take tables only.
# 2. Each contact vertex is looked up in the object's mask inside its window (a square of 1.3 times
#    the box); vertices beyond the window count at its border. No hit: no candidate.
# 3. Several candidates: those with at most 5 % of the hits of the best fall away, and all classes
#    but beds, chairs, sofas and tables. The one that owns most of the nearest object vertices is
#    touched, unless the mean squared distance to it is above 1 m^2.
# 4. A single candidate is touched if more than 20 vertices hit, however far it is.

CHAIRS = ("chair", "armchair", "office chair", "stool")  # one class in the authors' detector
TABLES = ("table", "coffee table", "dining table", "round table", "desk")
KEPT = (*CHAIRS, *TABLES, "bed", "sofa")
SHARE = 0.05  # of the hits of the best candidate
HITS = 20  # of a single candidate
FARTHEST = 1.0  # [m^2]
WINDOW = 1.3  # of the larger side of the box


@record
class Candidates:
    """The objects in the image and in the room."""

    categories: tuple[str, ...]
    masks: Bool[Tensor, "objects h w"]
    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]."""
    verts: Float[Tensor, "objects verts 3"]
    """Placed in the world [m]; padding is far away."""


def decide_by_mask_hits(
    points: Float[Tensor, "verts 3"],
    pixels: Int[Tensor, "verts 2"],
    person: Bool[Tensor, "h w"] | None,
    objects: Candidates,
    *,
    arms: bool,
) -> int:
    """Index of the object that one group of one body touches, -1 for none.

    Args:
        points: Contact vertices in the world [m].
        pixels: Where they are seen, x and y [px].
        person: The person's visible mask; None: unknown, so rule 1 asks for the class alone.
        objects: Who may be touched.
        arms: The group is hands and forearms.
    """
    hits = torch.stack(
        [_hits(pixels, m, b) for m, b in zip(objects.masks, objects.boxes, strict=True)]
    )
    may = _near(person, objects) & (hits > 0) & _is_one_of(objects, TABLES if arms else None)
    if int(may.sum()) > 1:
        may = may & (hits > SHARE * hits[may].max()) & _is_one_of(objects, KEPT)
        return _nearest(points, objects, may)
    if not bool(may.any()):
        return -1
    only = int(may.nonzero()[0, 0])
    return only if int(hits[only]) > HITS else -1


def _near(person: Bool[Tensor, "h w"] | None, objects: Candidates) -> Bool[Tensor, " objects"]:
    """Objects whose mask and box overlap those of the person."""
    if person is None:
        return torch.ones(len(objects.categories), dtype=torch.bool)
    if not bool(person.any()):
        return torch.zeros(len(objects.categories), dtype=torch.bool)
    y, x = person.nonzero().unbind(-1)
    box = torch.stack([x.min(), y.min(), x.max() + 1, y.max() + 1]).to(objects.boxes)
    shared = (objects.masks & person).any(-1).any(-1)
    return shared & (iou2d(objects.boxes, box.expand_as(objects.boxes)) > 0)


def _is_one_of(objects: Candidates, names: tuple[str, ...] | None) -> Bool[Tensor, " objects"]:
    return torch.tensor([names is None or c in names for c in objects.categories]).bool()


def _hits(
    pixels: Int[Tensor, "verts 2"], mask: Bool[Tensor, "h w"], box: Float[Tensor, "4"]
) -> Int[Tensor, ""]:
    """Number of vertices on the mask, clamped to the object's window."""
    middle, half = (box[:2] + box[2:]) / 2, WINDOW / 2 * (box[2:] - box[:2]).max()
    inside = torch.minimum(torch.maximum(pixels, middle - half), middle + half - 1).long()
    size = torch.tensor([mask.shape[1], mask.shape[0]])
    shown = ((inside >= 0) & (inside < size)).all(-1)
    x, y = torch.minimum(inside.clamp_min(0), size - 1).unbind(-1)
    return (mask[y, x] & shown).sum()


def _nearest(
    points: Float[Tensor, "verts 3"], objects: Candidates, may: Bool[Tensor, " objects"]
) -> int:
    """The candidate that owns most nearest vertices, if it is near enough."""
    if not bool(may.any()):
        return -1
    away = torch.full((len(may), len(points)), torch.inf).to(points)
    away[may] = torch.stack([torch.cdist(points, v).amin(-1) for v in objects.verts[may]])
    best = int(away.argmin(0).mode().values)
    return best if float(away[best].square().mean()) <= FARTHEST else -1


GROUPS = (
    ("seat", "left_thigh", "right_thigh"),
    ("back",),
    ("left_palm", "left_forearm"),
    ("right_palm", "right_forearm"),
)
FEWEST = 5  # vertices that a group must have to touch at all
MASK_HIT_GROUPS = (
    ("seat", "left_thigh", "right_thigh", "back"),
    ("left_palm", "right_palm", "left_forearm", "right_forearm"),
)
FAR_AWAY = 1e3  # [m], where padding goes


@record
class AssignInputs:
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
    """Their masks (`mask_hits`)."""


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
    """For the rule `mask_hits`."""


def contact_rows(inputs: AssignInputs, config: AssignConfig) -> Iterator[ContactRows]:
    """All touching vertices with their objects, one group of one body at a time."""
    rivals = _rivals(inputs)
    groups = MASK_HIT_GROUPS if config.by == "mask_hits" else GROUPS
    members = [
        torch.isin(inputs.parts.part_of, torch.tensor([PARTS.index(n) for n in names]))
        for names in groups
    ]
    touching = inputs.probability > config.chance
    asking = torch.stack([(touching & mine).sum(1) >= FEWEST for mine in members], 1)
    for body in _bodies(inputs, config, asking.any(1).nonzero()[:, 0].tolist()):
        seat = -1
        for group in asking[body.index].nonzero()[:, 0].tolist():
            names = groups[group]
            verts = (members[group] & touching[body.index]).nonzero()[:, 0]
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


def _bodies(inputs: AssignInputs, config: AssignConfig, asked: Sequence[int]) -> Iterator[_Body]:
    camera, bodies = small_camera(inputs.camera), inputs.bodies
    table = None
    if config.by == "mask_hits" and inputs.people is not None:
        table = mask_table(inputs.people, bodies)
    for index in asked:  # one at a time: memory stays that of one
        points = bodies.verts[index]
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        mask = None
        if table is not None and table.own[index] is not None:
            mask = small_masks(table.decode(index)[0].unsqueeze(0), inputs.camera)[0]
        yield _Body(index, points, pixels, mask)


def _rivals(inputs: AssignInputs) -> _Rivals:
    objects, layout = inputs.objects, inputs.layout
    boxes = small_boxes(inputs.boxes, inputs.camera)
    masks = _filled(small_masks(inputs.masks, inputs.camera), boxes)
    down = torch.nn.functional.max_pool2d(masks.float().unsqueeze(1), (7, 1), 1, (3, 0))
    grown = torch.nn.functional.max_pool2d(down, (1, 7), 1, (0, 3)).squeeze(1) > 0
    verts = place(objects.verts, layout)
    far_away = torch.full_like(verts, FAR_AWAY)
    verts = torch.where(objects.real_verts.unsqueeze(-1), verts, far_away)
    plain = Candidates(objects.categories, masks, boxes, verts)
    return _Rivals(grown, place(objects.top, layout), place(objects.back, layout), plain)


def _decide(
    part: _Group, rivals: _Rivals, objects: Objects, config: AssignConfig
) -> Int[Tensor, " verts"]:
    """Index of the object that each vertex touches, -1 for none."""
    if config.by == "mask_hits":
        plain = rivals.plain
        one = decide_by_mask_hits(part.points, part.pixels, part.mask, plain, arms=part.hands)
        return torch.full_like(part.pixels[:, 0], one)
    grown, shown = at_pixels(rivals.grown, part.pixels)
    over = grown & shown
    may = _may(objects, hands=part.hands)
    if config.by == "vertex":
        away = _distances(part.points, rivals.tops, rivals.backs)
        price = torch.where(over & may.unsqueeze(-1), away, torch.full_like(away, torch.inf))
        lowest, best = price.min(0)
        return torch.where(lowest < config.farthest, best, torch.full_like(best, -1))
    if part.seat >= 0:
        may = may & (torch.arange(len(may)) == part.seat)
    near = config.hand_reach if part.hands or part.lone_back else config.farthest
    share = over.float().mean(-1)
    able = (may & (share >= config.overlap)).nonzero()[:, 0]
    if not len(able):
        return torch.full_like(part.pixels[:, 0], -1)
    distance = _distances(part.points, rivals.tops[able], rivals.backs[able]).mean(-1)
    score = torch.where(distance < near, share[able] - distance, -torch.inf)
    best = able[score.argmax()] if bool(score.isfinite().any()) else torch.tensor(-1)
    return best.expand(over.shape[1])


def _may(objects: Objects, *, hands: bool) -> Bool[Tensor, " objects"]:
    """Seats take sitters and backs, other tops take hands."""
    return objects.has_top & ~objects.is_seat if hands else objects.is_seat


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
