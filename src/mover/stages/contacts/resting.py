"""Who rests on what: bodies that sit, lie, stand above the floor or lean on their hands.

A resting body part (a seat, a back that lies, soles above the floor, palms) is covered where the
top of a known object is within reach, or where it is seen before the mask of one that is not far.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts, members
from mover.bodies.posture import (
    LAP,
    Postures,
    at,
    facing,
    from_lap,
    landmarks,
    postures,
    speeds,
)
from mover.core.records import record
from mover.core.types import Bodies, Camera, Layout, Objects
from mover.geometry.boxes import Box
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.mesh import vertex_normals
from mover.geometry.placement import place
from mover.geometry.rotations import rot_y
from mover.stages.config import ProposeConfig
from mover.stages.masks import small_camera, small_masks

RESTS = ("seat", "left_thigh", "right_thigh", "back")  # parts that a seat or a bed carries
SOLES = ("left_sole", "right_sole")
FEWEST = 10  # vertices of a part that rests
LEVEL = 0.2  # [m] from a top, up or down, at most, of what rests on it
LOWEST = 0.2  # share of the points that touch below the height of what carries them
SAME = 0.3  # [m] between the middles of two rests on one support
ONE_TABLE = 0.6  # [m] of hands
WINDOW = 1.2  # [s] over which a hand is looked at
TREMBLE = 0.13  # [m], standard deviation of a resting palm, whose joints are off by degrees
DOWN = 0.5  # cosine of a palm's normal and down, mean over its skin (100-105: .7; on laps .4)
ARMREST = 0.24  # [m] to the side of a sitter's middle, from which a hand may be on an armrest
OVER_HIPS = 0.08  # [m] of a sitter's hand: armrests are 18 to 25 cm over the seat
AHEAD = 0.2  # [m] before the hips
TRUNK = 0.25  # [m] from the own trunk
ARM = 0.12  # [m] of a seat's width on each side, in which it may have an arm
HELD = 0.05  # [m] around a box that holds a hand

Kind = Literal["sit", "lie", "step", "hand"]


NO_BOXES = Box(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
NO_SEATS, NO_SIGHT = torch.zeros(0, dtype=torch.bool), torch.zeros(0, 0)


@record
class KnownTops:
    """What can carry somebody in the room as it is placed."""

    tops: Float[Tensor, "objects region 3"]
    """Points of seats, mattresses and table tops in the world [m]."""
    masks: Bool[Tensor, "objects h w"]
    """Pixels of the objects in the clean image."""
    is_seat: Bool[Tensor, " objects"]
    taken: tuple[str, ...]
    """Ids of all objects of the room."""
    boxes: Box = NO_BOXES
    """Of all objects."""
    sat_on: Bool[Tensor, " boxes"] = NO_SEATS
    """They are seats."""
    free: Float[Tensor, "fh fw"] = NO_SIGHT
    """How far each pixel's ray is seen to be free [m], in the image 640 wide."""


NOTHING = KnownTops(
    torch.zeros(0, 1, 3), torch.zeros(0, 1, 1, dtype=torch.bool), torch.zeros(0, dtype=torch.bool),
    (),
)  # fmt: skip
"""Of an empty room."""


def known_tops(
    objects: Objects, layout: Layout, masks: Bool[Tensor, "objects h w"], camera: Camera
) -> KnownTops:
    """What of a placed room can carry people; rays are free up to the objects that are seen."""
    rows = objects.has_top.nonzero()[:, 0]
    size = objects.size * layout.log_scale.exp()
    middle = layout.t_world_object + size * torch.tensor([0.0, 0.5, 0.0])
    nearest = to_camera(place(objects.verts, layout), camera.R_cam_world)[..., 2].amin(-1)
    free = (small_masks(masks, camera) * nearest.clamp_min(0)[:, None, None]).amax(0)
    return KnownTops(
        place(objects.top, layout)[rows], masks[rows], objects.is_seat[rows], objects.ids,
        Box(middle, size, layout.yaw), objects.is_seat, free,
    )  # fmt: skip


@record
class ProposeInputs:
    """The selected bodies in the world, what touches, and what is there to be touched."""

    bodies: Bodies
    parts: Parts
    chance: Float[Tensor, "bodies verts"]
    """That a vertex touches something."""
    floor: float
    camera: Camera
    known: KnownTops
    hidden: Float[Tensor, "fh fw"] = NO_SIGHT
    """How near bodies are of which something unknown hides a pixel, in the image 640 wide [m]."""

    @cached_property
    def pose(self) -> Postures:
        """How the bodies hold themselves."""
        return postures(self.bodies, self.parts, self.under)

    @cached_property
    def normals(self) -> Float[Tensor, "bodies verts 3"]:
        """Of the skin, outwards."""
        return vertex_normals(self.bodies.verts, self.bodies.faces)

    @property
    def under(self) -> float:
        """Height of the floor [m]."""
        return self.floor


@dataclass(frozen=True)
class Resting:
    """One body at rest on something."""

    row: int
    kind: Kind
    points: Float[Tensor, "verts 3"]
    """What touches [m]."""
    covered: bool
    """Something known carries it."""


@dataclass(frozen=True, eq=False)
class Place:
    """All rests at one place."""

    rests: Sequence[Resting]
    inputs: ProposeInputs

    @cached_property
    def rows(self) -> Int[Tensor, " rests"]:
        """Their bodies."""
        return torch.tensor([rest.row for rest in self.rests])

    @cached_property
    def heights(self) -> Float[Tensor, " rests"]:
        """Of what touches, over the floor [m]."""
        low = torch.stack([rest.points[:, 1].quantile(LOWEST) for rest in self.rests])
        return low - self.inputs.under[self.rows]

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        """Of what touches [m]."""
        return torch.stack([rest.points.mean(0) for rest in self.rests]).median(0).values


def resting_bodies(inputs: ProposeInputs, config: ProposeConfig) -> list[Resting]:
    """All bodies that sit, lie, stand above the floor or lean on their hands."""
    pose = inputs.pose
    seats = (inputs.chance > config.chance) & members(inputs.parts, *RESTS)
    kinds: tuple[tuple[Kind, Tensor], ...] = (
        ("sit", seats & pose.sitting[:, None]),
        ("lie", seats & pose.lying[:, None]),
        ("step", _raised(inputs, pose, config)),
    )
    found: list[Resting] = []
    for kind, rests in kinds:  # each body touches with another number of vertices
        for row in (rests.sum(1) >= FEWEST).nonzero()[:, 0].tolist():
            points = inputs.bodies.verts[row, rests[row]]
            if float(points[:, 1].median() - inputs.under[row]) > config.lowest:
                found.append(Resting(row, kind, points, _covered(points, inputs, config)))
    return found + _leaning(inputs, config)


def _raised(
    inputs: ProposeInputs, pose: Postures, config: ProposeConfig
) -> Bool[Tensor, "bodies verts"]:
    """Soles, still and as low as the body reaches, of those who stand."""
    bodies, part = inputs.bodies, members(inputs.parts, *SOLES)
    if not bool(part.any()):
        return torch.zeros_like(inputs.chance, dtype=torch.bool)
    height = bodies.verts[..., 1]
    lowest = height.amin(1, keepdim=True)
    still = speeds(bodies.verts[:, part].mean(1, keepdim=True), bodies)[:, 0] < config.speed
    return (height < lowest + 0.03) & part & (pose.standing & still)[:, None]


def _leaning(inputs: ProposeInputs, config: ProposeConfig) -> list[Resting]:
    """Bodies that lean on a palm: on what is still, level and before the own trunk for a while.

    Arms tremble where bodies were fitted, so that palms are taken where they are in the mean over
    `WINDOW`.
    """
    palms: dict[int, list[Tensor]] = {}
    for side in ("left", "right"):
        palm = members(inputs.parts, f"{side}_palm")
        if int(palm.sum()) < FEWEST:
            continue
        points = inputs.bodies.verts[:, palm]
        mean, spread = _averaged(points.mean(1), inputs.bodies)
        down = -inputs.normals[:, palm, 1].mean(1, keepdim=True)
        level = _averaged(down, inputs.bodies)[0][:, 0] > DOWN
        rests = level & (spread < TREMBLE) & _lean_at(mean, inputs, config)
        for row in rests.nonzero()[:, 0].tolist():
            there = points[row] - points[row].mean(0) + mean[row]
            palms.setdefault(row, []).append(there)
    return [
        Resting(
            row, "hand", torch.cat(both), any(_holds(row, palm, inputs, config) for palm in both)
        )
        for row, both in palms.items()
    ]


def _averaged(
    values: Float[Tensor, "bodies dims"], bodies: Bodies
) -> tuple[Float[Tensor, "bodies dims"], Float[Tensor, " bodies"]]:
    """Mean over `WINDOW` within each track, and the standard deviation about it."""
    if bodies.fps is None:
        return values, torch.zeros_like(values[:, 0])
    seconds = bodies.frame.double() / bodies.fps
    near = (seconds[:, None] - seconds).abs() <= WINDOW / 2 + 1e-6
    weight = (near & (bodies.person[:, None] == bodies.person)).to(values)
    weight = weight / weight.sum(1, keepdim=True)
    mean = weight @ values
    square = (weight @ values.square() - mean.square()).sum(1)
    return mean, square.clamp_min(0).sqrt()


def _lean_at(
    middle: Float[Tensor, "bodies 3"], inputs: ProposeInputs, config: ProposeConfig
) -> Bool[Tensor, " bodies"]:
    """Who may lean on a table with a hand at a place, by posture alone."""
    pose, places = inputs.pose, landmarks(inputs.bodies, inputs.parts)
    front, way = facing(places), middle - at(places, "hips")
    ahead = (way * front).sum(-1)
    aside = (way - ahead[:, None] * front)[:, [0, 2]].norm(dim=-1)
    knees = ((at(places, "knees") - at(places, "hips")) * front).sum(-1)
    arms = (aside < ARMREST) | (ahead > knees)  # no armrest is there
    seated = ~pose.sitting | (arms & (way[:, 1] > OVER_HIPS))
    high = middle[:, 1] - inputs.under
    free = (from_lap(middle, places) > LAP) & (_from_trunk(middle, places) > TRUNK)
    there = (ahead > AHEAD) & (high > config.lowest_hand) & (high < config.highest_hand)
    still = speeds(at(places, "hips")[:, None], inputs.bodies)[:, 0] < config.speed
    return seated & free & there & still & ~pose.lying


def _from_trunk(
    point: Float[Tensor, "bodies 3"], places: Float[Tensor, "bodies landmarks 3"]
) -> Float[Tensor, " bodies"]:
    """Distance to the line from hips to neck: folded arms are near it [m]."""
    hips, trunk = at(places, "hips"), at(places, "neck") - at(places, "hips")
    along = ((point - hips) * trunk).sum(-1) / trunk.square().sum(-1).clamp_min(1e-9)
    return (point - hips - along.clamp(0, 1)[:, None] * trunk).norm(dim=-1)


def _covered(
    points: Float[Tensor, "verts 3"], inputs: ProposeInputs, config: ProposeConfig
) -> bool:
    """Whether something known carries these points."""
    known = inputs.known
    if _on_top(points, known, config):
        return True
    aside = (known.tops - points.mean(0))[..., [0, 2]].norm(dim=-1)
    near = aside.amin(-1) < config.farthest
    return bool((_before(points, inputs, config) & known.is_seat & near).any())


def _on_top(points: Float[Tensor, "verts 3"], known: KnownTops, config: ProposeConfig) -> bool:
    """Whether a known top is below these points."""
    height = points[:, 1].quantile(LOWEST)
    aside = (known.tops - points.mean(0))[..., [0, 2]].norm(dim=-1)
    level = (known.tops[..., 1] - height).abs() < LEVEL
    return bool((level & (aside < config.reach)).any())


def _holds(
    row: int, points: Float[Tensor, "verts 3"], inputs: ProposeInputs, config: ProposeConfig
) -> bool:
    """Whether something known carries a palm.

    That may also be what is no seat and is seen there, or whose box holds the hand; of seats the
    arms beside who sits, and the upper edge.
    """
    known, middle = inputs.known, points.mean(0)
    boxes = known.boxes
    outside = ((middle - boxes.center)[:, None] @ rot_y(boxes.yaw))[:, 0].abs() - boxes.size / 2
    over = middle[1] - boxes.center[:, 1] - boxes.size[:, 1] / 2
    edge = (over.abs() < LEVEL / 2) | (inputs.pose.sitting[row] & (outside[:, 0] > -ARM))
    held = (outside[:, [0, 2]] < HELD).all(-1) & (over < LEVEL) & (edge | ~known.sat_on)
    if bool(held.any()) or _on_top(points, known, config):
        return True
    aside = (known.tops - middle)[..., [0, 2]].norm(dim=-1).amin(-1)
    level = (known.tops[..., 1].mean(-1) - middle[1]).abs() < 1.5 * LEVEL
    near = (aside < 2 * config.reach) & level & ~known.is_seat
    return bool((_before(points, inputs, config) & near).any())


def _before(
    points: Float[Tensor, "verts 3"], inputs: ProposeInputs, config: ProposeConfig
) -> Bool[Tensor, " objects"]:
    """The known objects before whose masks these points are seen."""
    camera = small_camera(inputs.camera)
    pixels = project(to_camera(points, camera.R_cam_world), camera.K).long()
    over, shown = at_pixels(small_masks(inputs.known.masks, inputs.camera), pixels)
    return (over & shown).float().mean(-1) > config.overlap


def grouped(rests: list[Resting]) -> list[list[Resting]]:
    """Rests of one kind whose middles are near one another, directly or through others.

    Seats and beds are one kind; hands at one table may be farther apart, but are as high.
    """
    from scipy.sparse.csgraph import connected_components

    if not rests:
        return []
    middle = torch.stack([rest.points.mean(0) for rest in rests])
    kind = torch.tensor([{"step": 1, "hand": 2}.get(rest.kind, 0) for rest in rests])
    apart = torch.cdist(middle[:, [0, 2]], middle[:, [0, 2]])
    tables = (kind == 2) & ((middle[:, None, 1] - middle[:, 1]).abs() < LEVEL / 2)
    near = (apart < torch.where(tables, ONE_TABLE, SAME)) & (kind[:, None] == kind)
    count, label = connected_components(near.numpy(), directed=False)
    return [[r for r, mine in zip(rests, label, strict=True) if mine == k] for k in range(count)]
