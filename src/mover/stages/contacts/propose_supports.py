"""Supports that no detector saw: where people rest, again and again, on nothing that is known.

Rests (`resting`) at one place make a group, over all people and the whole video. A group that
nothing known covers and that lasts is a support. Hands tell a table (`propose_tables`). Else the
class follows from posture, the place from the middle of what touches, the height from its lowest
layer, the front from where people look, the size from the class and from how wide the place is that
they touch. Who sits across to those who lie, near the edge, sits on a sofa: it reaches from one end
of all of them to the other. What rests on a piece for several belongs to it.

A proposal is no object: nothing else of the room depends on it until somebody accepts it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.posture import at, facing, headings, landmarks
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Proposal, SceneObject
from mover.furniture.library import SEEDS, make_piece
from mover.furniture.pieces import Furniture
from mover.geometry.boxes import beyond, box_of
from mover.geometry.rotations import rot_y
from mover.stages.config import ProposeConfig
from mover.stages.contacts.propose_tables import HandPlace, likeliest_top
from mover.stages.contacts.resting import (
    LEVEL,
    SAME,
    Kind,
    Place,
    ProposeInputs,
    grouped,
    resting_bodies,
)

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


@record
class Proposals:
    """Supports that no detector saw."""

    found: tuple[Proposal, ...]


def leans_on_nothing(inputs: ProposeInputs, config: ProposeConfig) -> bool:
    """Whether a table will be looked for."""
    return any(group.is_table for group in _uncovered(inputs, config))


def _uncovered(inputs: ProposeInputs, config: ProposeConfig) -> list["Group"]:
    """Places where people rest for long on nothing known."""
    groups = [Group(rests, inputs) for rests in grouped(resting_bodies(inputs, config))]
    return [g for g in groups if g.covered < config.covered and g.seconds >= config.seconds]


def propose_supports(
    inputs: ProposeInputs, config: ProposeConfig, observe: Observer = silent
) -> Proposals:
    """What people rest on that is not in the room, the longest used first."""
    del observe
    if not config.use:
        return Proposals(())
    held = _uncovered(inputs, config)
    found = _seats([group for group in held if not group.is_table], inputs)
    tables = [group for group in held if group.is_table]
    taken = {*inputs.known.taken, *(one.object.id for one in found)}
    boxes = [box_of(one.object) for one in found]
    tables = [g for g in tables if all(bool((beyond(b, g.middle) > 0).any()) for b in boxes)]
    while tables:
        group, *tables = tables
        proposal = _table(group, taken)
        if same := [other for other in tables if _at_table(proposal.object, group, other)]:
            rests = [rest for part in (group, *same) for rest in part.rests]
            tables = [Group(rests, inputs), *(one for one in tables if one not in same)]
            continue
        found.append(proposal)
        taken.add(proposal.object.id)
    return Proposals(tuple(sorted(found, key=lambda proposal: -proposal.seconds)))


@dataclass(frozen=True, eq=False)
class Group(Place):
    """All rests at one place that one piece may carry."""

    @property
    def is_table(self) -> bool:
        """Hands rest here."""
        return self.rests[0].kind == "hand"

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
    def middle(self) -> Float[Tensor, "3"]:
        """Of what touches; of the whole body where people lie [m]."""
        if self.lies:
            return self.inputs.bodies.verts[self.rows_of("lie")].mean(1).median(0).values
        return super().middle

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
        return bool(self.inputs.pose.recline[self.rows_of("sit")].median() > LEANS)

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
    return _named(group, (kind, seed, piece), (place, yaw, scale), taken)


Where = tuple[Float[Tensor, "3"], Float[Tensor, ""], Float[Tensor, "3"]]


def _table(group: Group, taken: set[str]) -> Proposal:
    """A piece of the library under the hands of a group."""
    place = HandPlace(group.rests, group.inputs)
    top = likeliest_top(place)
    seed, piece = _of_height(place.kind, place.height)
    wide, _, deep = piece.size
    size = top.size[0] / wide, place.height / piece.top_height, top.size[1] / deep
    where = top.middle, place.yaw, torch.tensor(size)
    return _named(group, (place.kind, seed, piece), where, taken)


def _named(
    group: Group, chosen: tuple[str, int, Furniture], where: Where, taken: set[str]
) -> Proposal:
    """A piece on the floor at a place, under a name of its own."""
    kind, seed, piece = chosen
    place = where[0].clone()
    place[1] = group.inputs.under[group.rows].median()
    stem = f"proposed_{kind.replace(' ', '_')}"
    name = next(n for n in (f"{stem}_{k}" for k in range(len(taken) + 1)) if n not in taken)
    return Proposal(
        SceneObject(name, piece.category, piece.mesh, "", None, "ground", place, *where[1:]),
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


def _seats(held: list[Group], inputs: ProposeInputs) -> list[Proposal]:
    """Seats, beds and steps; what rests on a piece for several belongs to it."""
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
    return found


def _at_table(table: SceneObject, group: Group, other: Group) -> bool:
    """Whether hands elsewhere lean on the same table."""
    level = float((group.heights.median() - other.heights.median()).abs()) < LEVEL / 2
    return level and bool((beyond(box_of(table), other.middle) < SAME).all())


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
