"""Find what body parts touch: the chance of every vertex, and the objects that they are given to.

A part goes to an object by the overlap of its projection with the objects' masks and by the
distance in 3D: `contact_association` has the rules of both presets (Sec. 3.1).
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mover.bodies.parts import PARTS, BodyParts
from mover.bodies.posture import at, elevation, headings, landmarks, postures, touching
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Bodies
from mover.energy.human_terms import ContactPoints, shares_of
from mover.geometry.mesh import vertex_normals
from mover.stages.config import AssignConfig, ContactConfig
from mover.stages.contacts.contact_association import AssignInputs, ContactRows, contact_rows


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


# Thin clouds of points out to cells, so that their number does not grow with the video.


GOLDEN = 0.6180339887498949  # its multiples, modulo 1, fill the unit interval evenly


def thin(
    points: Float[Tensor, "points 3"],
    group: Int[Tensor, " points"],
    groups: int,
    limits: tuple[float, int],
) -> tuple[Float[Tensor, "groups most 3"], Float[Tensor, "groups most"]]:
    """One point, their mean, for all points of a group in one cell; and how many they were.

    Args:
        points: All points [m].
        group: Group of each point.
        groups: Number of groups.
        limits: Edge of a cell [m], and the number of points of a group that are kept at most:
            where there are more cells, evenly chosen ones stand for all.
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
