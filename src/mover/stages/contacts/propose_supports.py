"""Supports that no detector saw: where people rest, again and again, on nothing that is known.

A resting body part (a seat, a back that lies, soles above the floor) is covered where the top of a
known object is within reach, or where it is seen before the mask of a known seat that is not far.
Rests at one place make a group, over all people and the whole video. A group that is not covered
and lasts is a support: the class follows from posture, the place from the middle of what touches,
the height from its lowest layer, the front from where people look, the size from the class and from
how wide the place is that they touch. Who sits across to those who lie, near the edge, sits on a
sofa: it reaches from one end of all of them to the other. What rests on a piece for several belongs
to it.

A proposal is no object: nothing else of the room depends on it until somebody accepts it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts, members
from mover.bodies.posture import Postures, at, facing, headings, landmarks, postures, speeds
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Bodies, Camera, Proposal, SceneObject
from mover.furniture.floor import Floor, height_under_bodies
from mover.furniture.library import SEEDS, make_piece
from mover.furniture.pieces import Furniture
from mover.geometry.boxes import beyond, box_of
from mover.geometry.camera import project, to_camera
from mover.geometry.rotations import rot_y
from mover.stages.config import ProposeConfig
from mover.stages.masks import small_camera, small_masks

RESTS = ("seat", "left_thigh", "right_thigh", "back")  # parts that a seat or a bed carries
SOLES = ("left_sole", "right_sole")
FEWEST = 10  # vertices of a part that rests
LEVEL = 0.2  # [m] from a top, up or down, at most, of what rests on it
LOWEST = 0.2  # share of the points that touch below the height of what carries them
SAME = 0.3  # [m] between the middles of two rests on one support
UNORDERED = 1.0  # [s] that an image without time stands for
LEANS = 0.2  # [rad] of a trunk behind upright: its seat has a back
UPRIGHT = 0.1  # [m] before the middle of its seat sits who does not lean (rooms 100-115)
LIES = 0.2  # share of the rests that make a seat a bed
ACROSS = 0.7  # sine of the angle between who sits and who lies, on a seat that is lain on along
REACH = 0.12  # [m] beyond the front edge of what touches of a sitter
NARROW = 0.36  # [m] from the middle of those who lie to the front edge: less is no bed
LONG = frozenset({"single bed", "sofa", "bench"})
WIDE = 0.8  # [m] of what touches, from side to side: more than one seat
EDGE = 0.05  # [m] around what touches that at least belongs to what carries it
ENDS = 0.02  # share of the points, and of the rests, beyond each end
STEADY = 0.04  # [m] by which the heights of rests on one support differ

Kind = Literal["sit", "lie", "step"]


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


NOTHING = KnownTops(
    torch.zeros(0, 1, 3), torch.zeros(0, 1, 1, dtype=torch.bool), torch.zeros(0, dtype=torch.bool),
    (),
)  # fmt: skip
"""Of an empty room."""


@record
class ProposeInputs:
    """The selected bodies in the world, what touches, and what is there to be touched."""

    bodies: Bodies
    parts: Parts
    chance: Float[Tensor, "bodies verts"]
    """That a vertex touches something."""
    floor: Floor
    camera: Camera
    known: KnownTops

    @cached_property
    def under(self) -> Float[Tensor, " bodies"]:
        """Height of the floor under each body [m]."""
        return height_under_bodies(self.floor, self.bodies)


@dataclass(frozen=True)
class Resting:
    """One body at rest on something."""

    row: int
    kind: Kind
    points: Float[Tensor, "verts 3"]
    """What touches [m]."""
    covered: bool
    """Something known carries it."""


@record
class Proposals:
    """Supports that no detector saw."""

    found: tuple[Proposal, ...]


def propose_supports(
    inputs: ProposeInputs, config: ProposeConfig, observe: Observer = silent
) -> Proposals:
    """What people rest on that is not in the room, the longest used first."""
    del observe
    if not config.use:
        return Proposals(())
    groups = [Group(rests, inputs) for rests in grouped(resting_bodies(inputs, config))]
    held = [g for g in groups if g.covered < config.covered and g.seconds >= config.seconds]
    held.sort(key=lambda group: (_kind_of(group) not in LONG, -group.seconds))
    taken = set(inputs.known.taken)
    found: list[Proposal] = []
    while held:
        group, *held = held
        proposal = _proposal(group, taken)
        under = [other for other in held if _stands_under(proposal.object, other.middle)]
        if under and proposal.piece in LONG:
            rests = [rest for part in (group, *under) for rest in part.rests]
            proposal = _proposal(Group(rests, inputs), taken)
        held = [other for other in held if not _stands_under(proposal.object, other.middle)]
        found.append(proposal)
        taken.add(proposal.object.id)
    return Proposals(tuple(sorted(found, key=lambda proposal: -proposal.seconds)))


def resting_bodies(inputs: ProposeInputs, config: ProposeConfig) -> list[Resting]:
    """All bodies that sit, lie or stand above the floor."""
    pose = postures(inputs.bodies, inputs.parts, inputs.under)
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
    return found


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


def _covered(
    points: Float[Tensor, "verts 3"], inputs: ProposeInputs, config: ProposeConfig
) -> bool:
    """Whether something known carries these points."""
    known, middle = inputs.known, points.mean(0)
    if len(known.tops) == 0:
        return False
    height = points[:, 1].quantile(LOWEST)
    aside = (known.tops - middle)[..., [0, 2]].norm(dim=-1)
    level = (known.tops[..., 1] - height).abs() < LEVEL
    if bool((level & (aside < config.reach)).any()):
        return True
    camera = small_camera(inputs.camera)
    x, y = project(to_camera(points, camera.R_cam_world), camera.K).long().unbind(-1)
    shown = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    masks = small_masks(known.masks, inputs.camera)
    over = masks[:, y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)] & shown
    before = over.float().mean(-1) > config.overlap
    return bool((before & known.is_seat & (aside.amin(-1) < config.farthest)).any())


def grouped(rests: list[Resting]) -> list[list[Resting]]:
    """Rests of one kind whose middles are near one another, directly or through others."""
    from scipy.sparse.csgraph import connected_components

    if not rests:
        return []
    middle = torch.stack([rest.points.mean(0) for rest in rests])
    step = torch.tensor([rest.kind == "step" for rest in rests])
    near = (torch.cdist(middle[:, [0, 2]], middle[:, [0, 2]]) < SAME) & (step[:, None] == step)
    count, label = connected_components(near.numpy(), directed=False)
    return [[r for r, mine in zip(rests, label, strict=True) if mine == k] for k in range(count)]


@dataclass(frozen=True)
class Group:
    """All rests at one place."""

    rests: Sequence[Resting]
    inputs: ProposeInputs

    @property
    def rows(self) -> Int[Tensor, " rests"]:
        """Their bodies."""
        return torch.tensor([rest.row for rest in self.rests])

    @cached_property
    def covered(self) -> float:
        """Share that something known carries."""
        return sum(rest.covered for rest in self.rests) / len(self.rests)

    @cached_property
    def seconds(self) -> float:
        """How long people rest here [s]."""
        bodies = self.inputs.bodies
        moments = len(bodies.frame[self.rows].unique())
        if bodies.fps is None or len(bodies.frame) < 2:
            return moments * UNORDERED
        gaps = bodies.frame.unique().diff()
        return moments * float(gaps.double().median() if len(gaps) else 1.0) / bodies.fps

    @cached_property
    def heights(self) -> Float[Tensor, " rests"]:
        """Of what touches, over the floor [m]."""
        low = torch.stack([rest.points[:, 1].quantile(LOWEST) for rest in self.rests])
        return low - self.inputs.under[self.rows]

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        """Of what touches; of the whole body where people lie [m]."""
        if self.lies:
            return self.inputs.bodies.verts[self.rows_of("lie")].mean(1).median(0).values
        return torch.stack([rest.points.mean(0) for rest in self.rests]).median(0).values

    def rows_of(self, kind: Kind) -> Int[Tensor, " rests"]:
        """The bodies that rest in one way."""
        return torch.tensor([r.row for r in self.rests if r.kind == kind], dtype=torch.long)

    @cached_property
    def lies(self) -> bool:
        """People lie here."""
        return sum(rest.kind == "lie" for rest in self.rests) > LIES * len(self.rests)

    @cached_property
    def leans(self) -> bool:
        """Most who sit here lean back."""
        pose = postures(self.inputs.bodies, self.inputs.parts, self.inputs.under)
        return bool(pose.recline[self.rows_of("sit")].median() > LEANS)

    @cached_property
    def yaw(self) -> Float[Tensor, ""]:
        """Where the front is: sitters look there, on a bed feet of liers are there [rad]."""
        if not self.lies:
            return _angle(self.way(self.rests[0].kind))
        return self.sofa if self.sofa is not None else _angle(self.way("lie"))

    def way(self, kind: Kind) -> Float[Tensor, "3"]:
        """Sum of where they look, or of where the feet of liers are."""
        return torch.nan_to_num(self._ways[kind][self.rows_of(kind)]).sum(0)

    @cached_property
    def _ways(self) -> dict[Kind, Float[Tensor, "bodies 3"]]:
        bodies, parts = self.inputs.bodies, self.inputs.parts
        places = landmarks(bodies, parts)
        return {
            "sit": headings(bodies, parts, self.inputs.under),
            "lie": at(places, "hips") - at(places, "neck"),
            "step": facing(places),
        }

    @cached_property
    def sofa(self) -> Float[Tensor, ""] | None:
        """Front of a seat on which people lie along and sit across [rad]; None: it is none."""
        sits = self.rows_of("sit")
        if not self.lies or not len(sits):
            return None
        lie, sit = _angle(self.way("lie")), self.way("sit")
        across = torch.stack([lie.cos(), torch.zeros_like(lie), -lie.sin()])
        side = torch.dot(across, sit)
        if float(side.abs()) < ACROSS * float(sit.norm()):
            return None
        front = across * side.sign()
        points = torch.cat([rest.points for rest in self.rests if rest.kind == "sit"])
        edge = float(torch.quantile(points @ front, 1 - ENDS)) - REACH
        return _angle(front) if edge - float(self.middle @ front) < NARROW else None

    @cached_property
    def span(self) -> tuple[Float[Tensor, "2"], Float[Tensor, "2"]]:
        """Least and largest x and z of all that rests, in axes whose z is the front [m].

        Of people who lie on a sofa the whole body counts.
        """
        points = [torch.cat([rest.points for rest in self.rests])]
        if self.sofa is not None:  # few who sit at one end count as much as many who lie
            lying = self.inputs.bodies.verts[self.rows_of("lie")]
            points = [*(rest.points for rest in self.rests), *lying]
        turn, some = rot_y(self.yaw), torch.tensor([ENDS, 1 - ENDS])
        ends = [torch.quantile((each @ turn)[:, [0, 2]], some, dim=0) for each in points]
        low, high = torch.stack(ends).unbind(1)
        return low.quantile(ENDS, dim=0), high.quantile(1 - ENDS, dim=0)

    @property
    def extent(self) -> Float[Tensor, "2"]:
        """Width and depth of all that rests, seen from the front [m]."""
        low, high = self.span
        return high - low


def _angle(way: Float[Tensor, "3"]) -> Float[Tensor, ""]:
    """About +y, from +z to a direction [rad]."""
    return torch.atan2(way[0], way[2])


def _proposal(group: Group, taken: set[str]) -> Proposal:
    """A piece of the library under a group."""
    kind, height, yaw = _kind_of(group), float(group.heights.median()), group.yaw
    seed, piece = _of_height(kind, height)
    scale = _scale(group, kind, piece, height)
    front = torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
    forward = 0.0 if group.leans or group.rests[0].kind != "sit" else UPRIGHT
    place = group.middle - forward * front
    if group.sofa is not None:  # between both ends; who lies is in the middle of its seat
        side = torch.stack([yaw.cos(), torch.zeros_like(yaw), -yaw.sin()])
        seat = (piece.seat_back + piece.seat_front) / 2 * float(scale[2])
        place = group.middle - seat * front
        low, high = group.span
        place = place + ((low + high)[0] / 2 - place @ side) * side
    place[1] = group.inputs.under[group.rows].median()
    stem = f"proposed_{kind.replace(' ', '_')}"
    name = next(n for n in (f"{stem}_{k}" for k in range(len(taken) + 1)) if n not in taken)
    where = place, yaw, scale
    return Proposal(
        SceneObject(name, piece.category, piece.mesh, "", None, "ground", *where),
        kind, 0, seed, _certainty(group), len(group.rests), group.seconds,
    )  # fmt: skip


def _scale(group: Group, kind: str, piece: Furniture, height: float) -> Float[Tensor, "3"]:
    """Of a piece, so that it is as high as what rests on it, and as wide where that tells."""
    size, scale = torch.tensor(piece.size), torch.ones(3)
    scale[1] = height / (piece.seat_height or piece.top_height)
    wanted = group.extent + 2 * EDGE
    if group.sofa is not None:
        scale[0] = wanted[0] / (piece.seat_right - piece.seat_left)
        return scale
    scale[[0, 2]] = (wanted / size[[0, 2]]).clamp_min(1.0)
    if kind in ("chair", "stool"):  # thighs reach beyond its front edge
        scale[2] = 1.0
    return scale


def _stands_under(piece: SceneObject, point: Float[Tensor, "3"]) -> bool:
    """Whether a piece's footprint, and half of `SAME` around it, holds a point."""
    return bool((beyond(box_of(piece), point) < SAME / 2).all())


def _kind_of(group: Group) -> str:
    """A name of `furniture.library.PIECES`."""
    if group.rests[0].kind == "step":
        return "step"
    if group.lies:
        return "single bed" if group.sofa is None else "sofa"
    wide = bool(group.extent[0] > WIDE)
    if group.leans:
        return "sofa" if wide else "chair"
    return "bench" if wide else "stool"


def _of_height(kind: str, height: float) -> tuple[int, Furniture]:
    """The seed of the piece whose seat, or top, is nearest to a height, and the piece."""
    pieces = [make_piece(kind, np.random.default_rng(seed), 0) for seed in range(SEEDS)]
    off = [abs(height - (piece.seat_height or piece.top_height)) for piece in pieces]
    seed = int(np.argmin(off))
    return seed, pieces[seed]


def _certainty(group: Group) -> float:
    """From 0 to 1: long, of one height, and never where something known could carry it."""
    time = group.seconds / (group.seconds + 1)
    spread = float(group.heights.std()) if len(group.rests) > 1 else STEADY
    return (1 - group.covered) * time * float(np.exp(-0.5 * (spread / (2 * STEADY)) ** 2))
