"""Find what body parts touch: the chance of every vertex, and the objects that they are given to.

A part goes to an object by the overlap of its projection with the objects' masks and by the
distance in 3D (Sec. 3.1, "Contact constraint"). `vertex` (printed) gives each vertex to the nearest
object whose mask it projects into, `mask_hits` (paper) decides by the rules of the authors'
released code (`decide_by_mask_hits`), `group` (robust) once for each body and group of parts, so
that single wrong vertices have no weight, and lets only seats take a sitter and only other
furniture a hand. A body's back touches what its seat touches. Hands that rest in the air and backs
that lean on nothing are the commonest false contacts of bodies with a few degrees of pose error:
they touch only what is within reach.
"""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mover.bodies.parts import PARTS, BodyParts, members
from mover.bodies.posture import at, elevation, headings, landmarks, postures, touching
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Bodies, Camera, Layout, Objects, People
from mover.energy.human_terms import ContactPoints, shares_of
from mover.geometry.boxes import iou2d
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.mesh import vertex_normals
from mover.geometry.placement import place
from mover.stages.config import AssignConfig, ContactConfig
from mover.stages.masks import mask_table, small_boxes, small_camera, small_masks, widened


@record
class ContactInputs:
    """Bodies in the world whose up is true, and what the user knows of their contacts."""

    bodies: Bodies
    parts: BodyParts
    ground: float
    """Height of the floor [m]."""
    given: Float[Tensor, "bodies verts"] | None


@record
class ContactProbability:
    """Chance that each vertex touches something."""

    probability: Float[Tensor, "bodies verts"]


def find_contacts(
    inputs: ContactInputs, config: ContactConfig, _observe: Observer = silent
) -> ContactProbability:
    """Contacts by geometry and motion: seat and thighs, back, hands, soles."""
    if config.given and inputs.given is not None:
        return ContactProbability(inputs.given)
    return ContactProbability(touching(inputs.bodies, inputs.parts, inputs.ground))


GOLDEN = 0.6180339887498949  # its multiples, modulo 1, fill the unit interval evenly


def thin(
    points: Float[Tensor, "points 3"],
    group: Int[Tensor, " points"],
    groups: int,
    limits: tuple[float, int],
) -> tuple[Float[Tensor, "groups most 3"], Float[Tensor, "groups most"]]:
    """One point [m], their mean, for all points of a group in one cell; and how many they were.

    `limits` are the edge of a cell [m] and the most points of a group: where there are more cells,
    evenly chosen ones stand for all.
    """
    cell, most = limits
    key = torch.cat([group.unsqueeze(-1), (points / cell).floor().long()], -1)
    cells, owner, count = key.unique(dim=0, return_inverse=True, return_counts=True)
    means = torch.zeros(len(cells), 3, dtype=points.dtype).index_add(0, owner, points)
    means, count = means / count.unsqueeze(-1), count.to(points)
    every = [(cells[:, 0] == g).nonzero()[:, 0] for g in range(groups)]
    kept = [evenly(mine, most) for mine in every]
    longest = max(1, max(len(rows) for rows in kept))
    found, weight = points.new_zeros(groups, longest, 3), points.new_zeros(groups, longest)
    for g, (mine, rows) in enumerate(zip(every, kept, strict=True)):
        share = count[rows]
        found[g, : len(rows)] = means[rows]
        weight[g, : len(rows)] = share * (count[mine].sum() / share.sum().clamp_min(1))
    return found, weight


def evenly(rows: Int[Tensor, " rows"], most: int) -> Int[Tensor, " some"]:
    """At most so many of them, evenly spread, the first and the last among them."""
    return rows[torch.linspace(0, len(rows) - 1, min(most, len(rows))).round().long()]


def in_turns(count: int) -> Int[Tensor, " count"]:
    """An order of so many rows whose beginnings are all spread evenly (golden ratio)."""
    return (torch.arange(count, dtype=torch.float64) * GOLDEN % 1).argsort()


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
COMPARED = 40  # vertices of a group whose distances are measured, at least
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


@record
class Candidates:
    """The objects in the image at most 640 wide and in the room."""

    categories: tuple[str, ...]
    masks: Bool[Tensor, "objects h w"]
    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]."""
    verts: Float[Tensor, "objects verts 3"]
    """Placed in the world [m]; padding is far away."""


def contact_rows(inputs: AssignInputs, config: AssignConfig) -> Iterator[ContactRows]:
    """All touching vertices with their objects, one group of one body at a time."""
    if config.by == "vertex":
        yield from _by_vertex(inputs)
        return
    by_hits, bodies, camera = config.by == "mask_hits", inputs.bodies, small_camera(inputs.camera)
    groups = MASK_HIT_GROUPS if by_hits else GROUPS
    verts_of = [members(inputs.parts, *names) for names in groups]
    touching = inputs.probability > CHANCE
    enough = torch.stack([(touching & mine).sum(1) >= FEWEST for mine in verts_of], 1)
    candidates = _candidates(inputs)
    objects, layout = inputs.objects, inputs.layout
    surfaces = _Touchable(
        objects,
        widened(candidates.masks, 3),
        place(objects.top, layout),
        place(objects.back, layout),
    )
    table = mask_table(inputs.people, bodies) if by_hits and inputs.people is not None else None
    for index in enough.any(1).nonzero()[:, 0].tolist():  # memory stays that of one body
        points, person, seat = bodies.verts[index], None, -1
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        if table is not None and table.own[index] is not None:
            person = small_masks(table.decode(index)[0].unsqueeze(0), inputs.camera)[0]
        for group in enough[index].nonzero()[:, 0].tolist():
            names, verts = groups[group], (verts_of[group] & touching[index]).nonzero()[:, 0]
            skin, hands = (points[verts], pixels[verts]), names[0].endswith("palm")
            if by_hits:
                touched = decide_by_mask_hits(*skin, person, candidates, arms=hands)
            else:
                touched = surfaces.touched(*skin, names, seat)
            if names[0] == "seat":
                seat = touched
            if touched >= 0:
                body, object_of = (torch.full_like(verts, value) for value in (index, touched))
                yield ContactRows(body, verts, object_of, torch.full_like(verts, hands).bool())


def _by_vertex(inputs: AssignInputs) -> Iterator[ContactRows]:
    """Each touching vertex of the body with the nearest object whose mask it projects into."""
    bodies, camera, objects = inputs.bodies, small_camera(inputs.camera), inputs.objects
    hand, body = (members(inputs.parts, *names) for names in MASK_HIT_GROUPS[::-1])
    touching, masks = (inputs.probability > CHANCE) & (hand | body), _candidates(inputs).masks
    parts = [place(part, inputs.layout) for part in (objects.top, objects.back)]
    for index in touching.any(1).nonzero()[:, 0].tolist():
        verts = touching[index].nonzero()[:, 0]
        points = bodies.verts[index, verts]
        pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
        covered, shown = at_pixels(masks, pixels)
        top, back = (torch.cdist(points, part).amin(-1) for part in parts)
        away = torch.minimum(top, back.masked_fill(~objects.has_back[:, None], torch.inf))
        may = covered & shown & objects.has_top[:, None] & (away < FARTHEST)
        nearest = torch.where(may, away, torch.inf).argmin(0)
        touched = may.any(0)
        verts, object_of = verts[touched], nearest[touched]
        yield ContactRows(torch.full_like(verts, index), verts, object_of, hand[verts])


def _candidates(inputs: AssignInputs) -> Candidates:
    """The objects for `decide_by_mask_hits`; an object without a mask has its box."""
    objects, boxes = inputs.objects, small_boxes(inputs.boxes, inputs.camera)
    masks = small_masks(inputs.masks, inputs.camera)
    y, x = (torch.arange(n) + 0.5 for n in masks.shape[-2:])
    low, high = boxes[:, :2, None, None], boxes[:, 2:, None, None]
    inside = (x > low[:, 0]) & (x < high[:, 0])
    inside = inside & (y[:, None] > low[:, 1]) & (y[:, None] < high[:, 1])
    masks = torch.where(masks.any(-1).any(-1)[:, None, None], masks, inside)
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
        """Index of the object that a group touches, -1 for none."""
        objects, hands, back = self.objects, names[0].endswith("palm"), names == ("back",)
        may = objects.has_top & ~objects.is_seat if hands else objects.is_seat
        if back and seat >= 0:
            may = may & (torch.arange(len(may)) == seat)
        grown, shown = at_pixels(self.grown, pixels)
        share = (grown & shown).float().mean(-1)
        able = (may & (share >= OVERLAP)).nonzero()[:, 0]
        if not len(able):
            return -1
        some = points[:: max(1, len(points) // COMPARED)]
        ways = (torch.cdist(some, part[able]).amin(-1) for part in (self.tops, self.backs))
        distance = torch.minimum(*ways)[:, torch.cdist(points, some).argmin(-1)].mean(-1)
        near = HAND_REACH if hands or (back and seat < 0) else FARTHEST
        score = torch.where(distance < near, share[able] - distance, -torch.inf)
        return int(able[score.argmax()]) if bool(score.isfinite().any()) else -1


# Which object a group of contact vertices touches, by the rules of the authors' released code.
#
# The whole body (seat, thighs, back) and both arms (hands, forearms) are each given to one object:
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
SQUARED = 1.0  # [m^2]
WINDOW = 1.3  # of the larger side of the box


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
        objects: The objects that may be touched.
        arms: The group is hands and forearms.
    """
    boxed = zip(objects.masks, objects.boxes, strict=True)
    hits = torch.stack([_hits(pixels, mask, box) for mask, box in boxed])
    may = hits > 0
    if person is not None:
        may = may & (objects.masks & person).any(-1).any(-1)
        if bool(person.any()):
            y, x = person.nonzero().unbind(-1)
            box = torch.stack([x.min(), y.min(), x.max() + 1, y.max() + 1]).to(objects.boxes)
            may = may & (iou2d(objects.boxes, box.expand_as(objects.boxes)) > 0)
    if arms:
        may = may & torch.tensor([c in TABLES for c in objects.categories])
    if int(may.sum()) > 1:
        kept = torch.tensor([c in KEPT for c in objects.categories])
        may = may & (hits > SHARE * hits[may].max()) & kept
        return _nearest(points, objects, may)
    only = int(may.int().argmax())
    return only if bool(may.any()) and int(hits[only]) > HITS else -1


def _hits(
    pixels: Int[Tensor, "verts 2"], mask: Bool[Tensor, "h w"], box: Float[Tensor, "4"]
) -> Int[Tensor, ""]:
    """Number of vertices on the mask, clamped to the object's window."""
    middle, half = (box[:2] + box[2:]) / 2, WINDOW / 2 * (box[2:] - box[:2]).max()
    inside = torch.minimum(torch.maximum(pixels, middle - half), middle + half - 1).long()
    covered, shown = at_pixels(mask, inside)
    return (covered & shown).sum()


def _nearest(
    points: Float[Tensor, "verts 3"], objects: Candidates, may: Bool[Tensor, " objects"]
) -> int:
    """The candidate that owns most nearest vertices, if it is near enough."""
    if not bool(may.any()):
        return -1
    away = torch.full((len(may), len(points)), torch.inf).to(points)
    away[may] = torch.stack([torch.cdist(points, v).amin(-1) for v in objects.verts[may]])
    best = int(away.argmin(0).mode().values)
    return best if float(away[best].square().mean()) <= SQUARED else -1


LEVEL = 0.7071  # cosine of 45 degrees, the released code's split of the normals


@record
class ContactAssignment:
    """Which body touches which object."""

    points: ContactPoints | None
    """Contact points of each object; None: nothing is touched."""
    seated_on: Bool[Tensor, " bodies"]
    """Bodies whose seat or back touches an object."""
    bodies: tuple[int, ...]
    """Number of bodies that touch each object."""
    pairs: Int[Tensor, "pairs 3"]
    """Contacts: body, object, and part as in `ContactPoints.points`."""


def assign_contacts(
    inputs: AssignInputs, config: AssignConfig, _observe: Observer = silent
) -> ContactAssignment:
    """Give each touching part of each body to the object that it touches."""
    bodies, objects = inputs.bodies, inputs.objects
    found = [c for c in contact_rows(inputs, config) if len(c.body)]
    seated, counts = torch.zeros(len(bodies.frame), dtype=torch.bool), [0] * len(objects.ids)
    if not found:
        return ContactAssignment(None, seated, tuple(counts), torch.zeros(0, 3, dtype=torch.long))
    names = ("body", "vert", "object_of", "hand")
    rows = ContactRows(*(torch.cat([getattr(c, n) for c in found]) for n in names))
    seated[rows.body[~rows.hand]] = True
    part, touched = _parts(rows, inputs, config), rows.object_of.unique()
    packed, weight = thin(
        bodies.verts[rows.body, rows.vert],
        torch.searchsorted(touched, rows.object_of) * 4 + part,
        4 * len(touched),
        (config.cell, config.most),
    )
    back = objects.has_back[touched].float()
    usable = torch.stack([torch.ones_like(back), back, torch.ones_like(back), back], -1)
    weight = weight.unflatten(0, (len(touched), 4)) * usable.unsqueeze(-1)
    for i in touched.tolist():
        counts[i] = len(rows.body[rows.object_of == i].unique())
    points = ContactPoints(
        touched, packed.unflatten(0, (len(touched), 4)), weight,
        torch.tensor([counts[i] for i in touched.tolist()], dtype=packed.dtype),
        shares_of(weight), *_headings(rows, touched, inputs),
    )  # fmt: skip
    pairs = torch.stack([rows.body, rows.object_of, part], -1)
    sizes = pairs.amax(0) + 1  # unique as numbers, which sort far faster than rows
    place = torch.stack([sizes[1] * sizes[2], sizes[2], torch.ones_like(sizes[2])])
    pairs = (pairs @ place).unique()[:, None] // place % sizes
    return ContactAssignment(points, seated, tuple(counts), pairs)


def _parts(rows: ContactRows, inputs: AssignInputs, config: AssignConfig) -> Int[Tensor, " rows"]:
    """The part that each row touches: top, back, and the same for hands."""
    some, row = rows.body.unique(return_inverse=True)
    normals = vertex_normals(inputs.bodies.verts[some], inputs.bodies.faces)[row, rows.vert]
    level = normals[:, 1].abs() >= LEVEL
    if config.by == "group":  # backs alone touch backs, unless they lie
        level = level | (inputs.parts.part_of[rows.vert] != PARTS.index("back"))
    if config.by == "vertex":
        level = level | ~inputs.objects.has_back[rows.object_of]
    return (~level).long() + 2 * rows.hand.long()


LONG = 1.3  # times as long as wide: what people sit across
STEEP = 45.0  # [degrees] above level, at least, of the shins of people whose feet are on the floor


def _headings(
    rows: ContactRows, touched: Int[Tensor, " touched"], inputs: AssignInputs
) -> tuple[Float[Tensor, "touched 2"], Bool[Tensor, " touched"]]:
    """Mean horizontal direction of the people sitting or lying on each touched object; else zero.

    Seated people face as objects with a back do. On a bed or a bench they sit across the long side,
    their feet on the floor; round a stool they face anywhere. Lying people give the heading of a
    bed, whose back is where heads lie, and they count before those who sit on it.

    Returns:
        Unit vectors, and which of them are across the front.
    """
    bodies, parts, objects = inputs.bodies, inputs.parts, inputs.objects
    pose, places = postures(bodies, parts), landmarks(bodies, parts)
    facing = headings(bodies, parts)[:, [0, 2]]
    along = normalize((at(places, "hips") - at(places, "neck"))[:, [0, 2]], dim=-1)
    edge = pose.sitting & (elevation(at(places, "knees") - at(places, "ankles")) > STEEP)
    means, across = list[Tensor](), list[bool]()
    for o in touched.tolist():
        there = rows.body[(rows.object_of == o) & ~rows.hand].unique()
        bed, (width, _, depth) = objects.categories[o] == "bed", objects.size[o]
        lies = bed and bool(pose.lying[there].any())
        aside = not lies and not bool(objects.has_back[o])
        ways, does = (along, pose.lying) if lies else (facing, edge if aside else pose.sitting)
        known = not aside or float(torch.maximum(width / depth, depth / width)) > LONG
        ways = ways[there[does[there]]]
        if aside:  # up to half turns
            angle = 2 * torch.atan2(ways[:, 0], ways[:, 1])
            x, z = angle.sin().sum() / 2, angle.cos().sum() / 2
            turn = torch.atan2(x, z) / 2 + (math.pi / 2 if width > depth else 0)
            mean = torch.hypot(x, z) * torch.stack([turn.sin(), turn.cos()])
        else:
            mean = ways.sum(0)
        length = float(mean.norm())
        means.append(mean / length if known and length > 0.1 else 0 * mean)
        across.append(aside)
    return torch.stack(means), torch.tensor(across)
