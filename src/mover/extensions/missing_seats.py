"""Seats and beds that no detector saw: where people rest, again and again, on nothing known.

Not in the paper, which names missed detections as a failure (Sec. 5, "Failure cases"). A resting
part (a seat, a back that lies) is covered where the top of a known object is within reach, or where
it is seen before the mask of a seat that is not far. Rests at one position make a group, over all
people and the whole video; a group that nothing known covers and that lasts is a support. Its class
follows from posture, its height from the lowest layer of what touches, its front from where people
look, its size from the class and from how wide the touched area is. A person sitting across to
those lying, near the edge, sits on a sofa, which reaches from one end of all of them to the other.
What rests on a piece for several people belongs to it.

A proposal is no object of the room: nothing else depends on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import BodyParts, members, parts_of
from mover.bodies.posture import Postures, at, headings, landmarks, postures
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Capture, Layout, Proposal, Room, SceneObject
from mover.furniture.library import SEEDS, make_piece
from mover.furniture.pieces import Furniture
from mover.geometry.boxes import beyond, box_of
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.placement import place, placed_at
from mover.geometry.rotations import rot_y
from mover.io.capture.scene_file import write_scene
from mover.pipeline.presets import Config
from mover.stages.contacts.assign_contacts import ContactInputs, find_contacts
from mover.stages.masks import small_camera, small_masks
from mover.stages.objects.find_image_cues import image_evidence
from mover.stages.objects.prepare_objects import PrepareInputs, prepare_objects

PROPOSED = "proposed.json"
RESTS = ("seat", "left_thigh", "right_thigh", "back")  # parts that a seat or a bed carries
TOUCHES = 0.5  # chance of contact from which a vertex touches
FEWEST = 10  # vertices of a part that rests
LOW = 0.12  # [m] over the floor: lower rests need no support
LEVEL = 0.2  # [m] from a top, up or down, at most, of what rests on it
LOWEST = 0.2  # share of the points that touch below the height of the support
REACH = 0.25  # [m] aside of a known top that still carries
SEEN = 0.3  # share of the points seen before a known seat that it then carries ...
FARTHEST = 0.8  # ... [m] if it stands within this distance
COVERED = 0.5  # share of the rests at one position from which nothing is missing there
SECONDS = 1.5  # [s], shorter rests propose nothing
UNORDERED = 1.0  # [s] that an image without time stands for
SAME = 0.3  # [m] between the middles of two rests on one support
LEANS = 0.2  # [rad] of a trunk behind upright: its seat has a back
UPRIGHT = 0.1  # [m] from an upright sitter forward to the middle of the seat (rooms 100-115)
LIES = 0.2  # share of the rests that make a seat a bed
ACROSS = 0.7  # sine of the angle between those sitting and those lying on one sofa
THIGHS = 0.12  # [m] beyond the front edge of what touches of a sitter
NARROW = 0.36  # [m] from the middle of those lying to the front edge: less is no bed
LONG = frozenset({"single bed", "sofa", "bench"})
WIDE = 0.8  # [m] of what touches, from side to side: more than one seat
EDGE = 0.05  # [m] around what touches that at least belongs to the support
ENDS = 0.02  # share of the points, and of the rests, beyond each end
STEADY = 0.04  # [m] by which the heights of rests on one support differ


def with_missing_seats(room: Room, capture: Capture, config: Config, run: Run) -> Room:
    """The room with its proposals, the longest used first, and a warning for each."""
    if room.bodies is None or room.kept is None or room.scene.ground is None:
        return room
    bodies, ground = rows_of(room.bodies, room.kept), room.scene.ground
    parts = parts_of(bodies)
    given = None if capture.touch is None else capture.touch[room.kept]
    contacts = ContactInputs(bodies, parts, ground, given)
    chance = run.stage(find_contacts, contacts, config.contacts).probability
    people = Resting(bodies, parts, chance > TOUCHES, ground)
    known, taken = known_tops(room, capture, config, run), {p.id for p in room.scene.objects}
    proposals = [
        one
        for one in proposed(people, known, taken)
        if not any(_stood_there(piece, box_of(one.proposed).center) for piece in room.scene.objects)
    ]
    warnings = (
        f"{one.proposed.id}: people rest for {one.seconds:.0f} s on nothing that is known; a"
        f" {one.proposed.category} is proposed there (certainty {one.certainty:.2f})"
        for one in proposals
    )
    return replace(room, proposals=tuple(proposals), warnings=(*room.warnings, *warnings))


def _stood_there(piece: SceneObject, point: Float[Tensor, "3"]) -> bool:
    """Whether an object that is moved holds a point in one of its positions."""
    boxes = (box_of(placed_at(piece, segment.frame)) for segment in piece.segments)
    return any(bool((beyond(box, point) < 0).all()) for box in boxes)


def write_proposals(room: Room, path: Path) -> None:
    """Write proposed.json, a scene of the proposals; without any, an old file is removed."""
    if not room.proposals:
        path.unlink(missing_ok=True)
        return
    keys = ("piece", "style", "seed", "certainty", "bodies", "seconds")
    more = {one.proposed.id: {key: getattr(one, key) for key in keys} for one in room.proposals}
    objects = tuple(one.proposed for one in room.proposals)
    write_scene(replace(room.scene, objects=objects), path, more)


@dataclass(frozen=True)
class KnownTops:
    """What can carry a person in the room as it is placed."""

    tops: Float[Tensor, "objects region 3"]
    """Points of seats, mattresses and table tops in the world [m]."""
    masks: Bool[Tensor, "objects h w"]
    """Pixels of the objects in the clean image, of the size of `camera`."""
    is_seat: Bool[Tensor, " objects"]
    camera: Camera

    def carry(self, points: Float[Tensor, "verts 3"]) -> bool:
        """Whether something known carries the points of a body that rest."""
        aside = (self.tops - points.mean(0))[..., [0, 2]].norm(dim=-1)
        level = (self.tops[..., 1] - points[:, 1].quantile(LOWEST)).abs() < LEVEL
        if bool((level & (aside < REACH)).any()):
            return True
        pixels = project(to_camera(points, self.camera.R_cam_world), self.camera.K).long()
        over, shown = at_pixels(self.masks, pixels)
        before = (over & shown).float().mean(-1) > SEEN
        return bool((before & self.is_seat & (aside.amin(-1) < FARTHEST)).any())


def known_tops(room: Room, capture: Capture, config: Config, run: Run) -> KnownTops:
    """The tops of the objects of a finished room."""
    camera, pieces = small_camera(room.scene.camera), room.scene.objects
    if not pieces:
        nothing = torch.zeros(0, 1, 1, dtype=torch.bool)
        return KnownTops(torch.zeros(0, 1, 3), nothing, nothing[:, 0, 0], camera)
    prepared = run.stage(prepare_objects, PrepareInputs(capture.scene.objects), config.prepare)
    t, yaw, scale = (
        torch.stack([getattr(piece, key) for piece in pieces])
        for key in ("t_world_object", "yaw", "scale")
    )
    base = t + (rot_y(yaw) @ (scale * prepared.center)[..., None])[..., 0]
    layout, objects = Layout(base, yaw, (scale / prepared.scale).log()), prepared.objects
    rows = objects.has_top.nonzero()[:, 0]
    masks = small_masks(image_evidence(capture).masks[rows], room.scene.camera)
    return KnownTops(place(objects.top, layout)[rows], masks, objects.is_seat[rows], camera)


@dataclass(frozen=True, eq=False)
class Resting:
    """People in the world, and which of their vertices touch something."""

    bodies: Bodies
    parts: BodyParts
    touch: Bool[Tensor, "bodies verts"]
    ground: float

    @cached_property
    def pose(self) -> Postures:
        """How the bodies hold themselves."""
        return postures(self.bodies, self.parts, self.ground)

    @cached_property
    def sitting_fronts(self) -> Float[Tensor, "bodies 3"]:
        """Where sitting bodies look."""
        return headings(self.bodies, self.parts, self.ground)

    @cached_property
    def lying_ways(self) -> Float[Tensor, "bodies 3"]:
        """From the neck to the hips."""
        points = landmarks(self.bodies, self.parts)
        return at(points, "hips") - at(points, "neck")


@dataclass(frozen=True)
class Rest:
    """One body at rest on something."""

    row: int
    lies: bool
    points: Float[Tensor, "verts 3"]  #: what touches [m]
    covered: bool  #: something known carries it


def resting_bodies(people: Resting, known: KnownTops) -> list[Rest]:
    """All bodies that sit or lie above the floor."""
    bodies, seats = people.bodies, people.touch & members(people.parts, *RESTS)
    found: list[Rest] = []
    for lies, which in ((False, people.pose.sitting), (True, people.pose.lying)):
        rests = seats & which[:, None]
        for row in (rests.sum(1) >= FEWEST).nonzero()[:, 0].tolist():  # each by other vertices
            points = bodies.verts[row, rests[row]]
            if float(points[:, 1].median()) - people.ground > LOW:
                found.append(Rest(row, lies, points, known.carry(points)))
    return found


def grouped(rests: list[Rest], people: Resting) -> "list[RestGroup]":
    """Rests whose middles are near one another, directly or through others."""
    from scipy.sparse.csgraph import connected_components

    if not rests:
        return []
    middle = torch.stack([rest.points.mean(0) for rest in rests])[:, [0, 2]]
    count, label = connected_components((torch.cdist(middle, middle) < SAME).numpy(), False)
    members = ([r for r, own in zip(rests, label, strict=True) if own == k] for k in range(count))
    return [RestGroup(own, people) for own in members]


@dataclass(frozen=True, eq=False)
class RestGroup:
    """All rests at one position that one piece may carry."""

    rests: Sequence[Rest]
    people: Resting

    @cached_property
    def covered(self) -> float:
        """Share that something known carries."""
        return sum(rest.covered for rest in self.rests) / len(self.rests)

    @cached_property
    def seconds(self) -> float:
        """How long people rest here [s]."""
        bodies = self.people.bodies
        moments = len({int(bodies.frame[rest.row]) for rest in self.rests})
        if bodies.fps is None or len(bodies.frame) < 2:
            return moments * UNORDERED
        gaps = bodies.frame.unique().diff()
        return moments * float(gaps.double().median() if len(gaps) else 1.0) / bodies.fps

    @cached_property
    def heights(self) -> Float[Tensor, " rests"]:
        """Of what touches, over the floor [m]."""
        low = torch.stack([rest.points[:, 1].quantile(LOWEST) for rest in self.rests])
        return low - self.people.ground

    def rows(self, lies: bool) -> Int[Tensor, " rests"]:
        """The bodies that lie, or sit."""
        return torch.tensor([r.row for r in self.rests if r.lies == lies], dtype=torch.long)

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        """Of what touches; of the whole body where people lie [m]."""
        if self.lies:
            return self.people.bodies.verts[self.rows(True)].mean(1).median(0).values
        return torch.stack([rest.points.mean(0) for rest in self.rests]).median(0).values

    @cached_property
    def lies(self) -> bool:
        """People lie here."""
        return sum(rest.lies for rest in self.rests) > LIES * len(self.rests)

    @cached_property
    def leans(self) -> bool:
        """Most who sit here lean back."""
        return bool(self.people.pose.recline[self.rows(False)].median() > LEANS)

    @cached_property
    def yaw(self) -> Float[Tensor, ""]:
        """Where the front is: sitters look there, on a bed there are the feet [rad]."""
        if self.sofa is not None:
            return self.sofa
        lies = self.lies or self.rests[0].lies
        ways = self.people.lying_ways if lies else self.people.sitting_fronts
        return _angle(torch.nan_to_num(ways[self.rows(lies)]).sum(0))

    @cached_property
    def sofa(self) -> Float[Tensor, ""] | None:
        """Front of a seat on which people lie along and sit across [rad]; None: it is none."""
        sits = self.rows(False)
        if not self.lies or not len(sits):
            return None
        lie = _angle(torch.nan_to_num(self.people.lying_ways[self.rows(True)]).sum(0))
        sit = torch.nan_to_num(self.people.sitting_fronts[sits]).sum(0)
        across = torch.stack([lie.cos(), torch.zeros_like(lie), -lie.sin()])
        side = torch.dot(across, sit)
        if float(side.abs()) < ACROSS * float(sit.norm()):
            return None
        front = across * side.sign()
        points = torch.cat([rest.points for rest in self.rests if not rest.lies])
        edge = float(torch.quantile(points @ front, 1 - ENDS)) - THIGHS
        return _angle(front) if edge - float(self.middle @ front) < NARROW else None

    @cached_property
    def span(self) -> Float[Tensor, "2 2"]:
        """Least and largest x and z of all that rests, in axes whose z is the front [m].

        Of people lying on a sofa the whole body counts.
        """
        points = [torch.cat([rest.points for rest in self.rests])]
        if self.sofa is not None:  # few who sit at one end count as much as many who lie
            points = [*(r.points for r in self.rests), *self.people.bodies.verts[self.rows(True)]]
        turn, some = rot_y(self.yaw), torch.tensor([ENDS, 1 - ENDS])
        ends = [torch.quantile((each @ turn)[:, [0, 2]], some, dim=0) for each in points]
        low, high = torch.stack(ends).unbind(1)
        return torch.stack([low.quantile(ENDS, dim=0), high.quantile(1 - ENDS, dim=0)])

    @cached_property
    def kind(self) -> str:
        """A name of `furniture.library.PIECES`."""
        if self.lies:
            return "single bed" if self.sofa is None else "sofa"
        wide = float(self.span[1, 0] - self.span[0, 0]) > WIDE
        if self.leans:
            return "sofa" if wide else "chair"
        return "bench" if wide else "stool"

    @property
    def certainty(self) -> float:
        """From 0 to 1: long, of one height, and never where something known could carry it."""
        time = self.seconds / (self.seconds + 1)
        spread = float(self.heights.std()) if len(self.rests) > 1 else STEADY
        return (1 - self.covered) * time * float(np.exp(-0.5 * (spread / (2 * STEADY)) ** 2))


def _angle(way: Float[Tensor, "3"]) -> Float[Tensor, ""]:
    """About +y, from +z to a direction [rad]."""
    return torch.atan2(way[0], way[2])


def proposed(people: Resting, known: KnownTops, taken: set[str]) -> list[Proposal]:
    """A piece for each position where people rest for long on nothing known, the longest first.

    Ids are none of those that are taken. What rests on a piece for several belongs to it.
    """
    groups = grouped(resting_bodies(people, known), people)
    groups = [g for g in groups if g.covered < COVERED and g.seconds >= SECONDS]
    left = sorted(groups, key=lambda group: (group.kind not in LONG, -group.seconds))
    found: list[Proposal] = []
    while left:
        group, *left = left
        proposal = _proposal(group, taken)
        under = [other for other in left if _holds(proposal, other)]
        if under and proposal.piece in LONG:
            rests = [rest for part in (group, *under) for rest in part.rests]
            proposal = _proposal(RestGroup(rests, group.people), taken)
        left = [other for other in left if not _holds(proposal, other)]
        found.append(proposal)
        taken = {*taken, proposal.proposed.id}
    return sorted(found, key=lambda one: -one.seconds)


def _holds(proposal: Proposal, group: RestGroup) -> bool:
    """Whether a piece's footprint, and half of `SAME` around it, holds the middle of a group."""
    return bool((beyond(box_of(proposal.proposed), group.middle) < SAME / 2).all())


def _proposal(group: RestGroup, taken: set[str]) -> Proposal:
    """A piece of the library under a group, on the floor."""
    height, yaw = float(group.heights.median()), group.yaw
    pieces = [make_piece(group.kind, np.random.default_rng(seed), 0) for seed in range(SEEDS)]
    seed = int(np.argmin([abs(height - piece.seat_height) for piece in pieces]))
    piece = pieces[seed]
    scale = _scale(group, piece, height)
    front = torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
    upright = not group.leans and not group.rests[0].lies
    t = group.middle - (UPRIGHT if upright else 0.0) * front
    if group.sofa is not None:  # between both ends; people lying are in the middle of its seat
        side = torch.stack([yaw.cos(), torch.zeros_like(yaw), -yaw.sin()])
        seat = (piece.seat_back + piece.seat_front) / 2 * float(scale[2])
        t = group.middle - seat * front
        t = t + (group.span[:, 0].mean() - t @ side) * side
    t = torch.stack([t[0], t.new_tensor(group.people.ground), t[2]])
    stem = f"proposed_{group.kind.replace(' ', '_')}"
    name = next(n for n in (f"{stem}_{k}" for k in range(len(taken) + 1)) if n not in taken)
    return Proposal(
        SceneObject(name, piece.category, piece.mesh, "", None, "ground", t, yaw, scale),
        group.kind, 0, seed, group.certainty, len(group.rests), group.seconds,
    )  # fmt: skip


def _scale(group: RestGroup, piece: Furniture, height: float) -> Float[Tensor, "3"]:
    """Of a piece, so that it is as high as what rests on it, and as wide where that is known."""
    scale = torch.ones(3)
    scale[1] = height / piece.seat_height
    wanted = group.span[1] - group.span[0] + 2 * EDGE
    if group.sofa is not None:
        scale[0] = wanted[0] / (piece.seat_right - piece.seat_left)
        return scale
    scale[[0, 2]] = (wanted / torch.tensor(piece.size)[[0, 2]]).clamp_min(1.0)
    if group.kind in ("chair", "stool"):  # thighs reach beyond its front edge
        scale[2] = 1.0
    return scale
