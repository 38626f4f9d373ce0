r"""Furniture that moves with somebody: held by hand, or sat on.

Between two stays an object is put, unseen (then it jumps), or a person moves it. Who does is told
by motion alone: a rigid hold on the hands, or on the pelvis of who sits, carries the object from
its place before to its place after,

    T_k = H_k H_a^{-1} T_a,   and from the other end   H_k H_b^{-1} T_b

with H_k the hold (a place on the floor and a heading) in frame k. Of all first and last frames a, b
about the time between the stays those are taken that bring it nearest to where it is found after,
at a price for each frame; both ends are then met by going over from the first to the second.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts
from mover.bodies.posture import at, facing, landmarks, postures
from mover.core.records import record, rows_of
from mover.core.types import Bodies, SceneObject, Segment
from mover.geometry.boxes import beyond, box_of
from mover.geometry.placement import placed_at
from mover.geometry.rotations import rot_y, wrap
from mover.stages.config import MoveConfig

SMOOTH = (0.25, 0.5, 0.25)  # weights of the rows before, at and after: bodies tremble
FRAME = 0.01  # [m] of misfit that another frame must save
TURNED = 0.8  # [rad]; ends that disagree by more do so by a symmetry of the object
Hold = Literal["hands", "seat"]


@record
class Between:
    """Two stays of an object, and when it surely stands there."""

    before: SceneObject
    after: SceneObject
    last: int
    """Of the frames that surely show it where it stood before."""
    first: int
    """Of the frames that surely show it where it stands after."""


@record
class Followed:
    """How somebody moves an object."""

    person: int
    hold: Hold
    segments: tuple[Segment, ...]
    """One for each frame in which it moves, and the first of its next stay."""


@dataclass(frozen=True)
class _Holds:
    """Where a person could hold something, frame by frame."""

    frame: Int[Tensor, " frames"]
    place: Float[Tensor, "frames 2"]
    """(x, z) [m]"""
    heading: Float[Tensor, " frames"]
    """[rad]"""
    able: Bool[Tensor, " frames"]
    """Whether it can be held so: the person sits."""


def follow_mover(
    between: Between, people: tuple[Bodies, Parts], ground: float, config: MoveConfig
) -> Followed | None:
    """Who moves an object from one stay to the next, and how; None: nobody is seen to do so.

    Args:
        between: The two stays.
        people: All people in the world.
        ground: Height of the floor [m].
        config: How near hands and seats are, and how well the ends must fit.
    """
    bodies, parts = people
    if bodies.fps is None:
        return None
    margin = config.margin * bodies.fps
    near = (bodies.frame >= between.last - margin) & (bodies.frame <= between.first + margin)
    found: list[tuple[float, Followed]] = []  # of who sits on it the hands are near, too
    for person in bodies.person[near].unique().tolist():
        mine = rows_of(bodies, near & (bodies.person == person))
        mine = rows_of(mine, mine.frame.argsort())
        if len(mine.frame) < 3:
            continue
        for hold, held in _holds(mine, parts, ground):
            best = _fitted(between, held, hold, config)
            if best is not None:
                misfit, first, last = best
                moving = _segments(between, held, first, last, person)
                found.append((misfit, Followed(person, hold, moving)))
    best = min(found, key=lambda pair: (pair[1].hold != "seat", pair[0]), default=None)
    return None if best is None else best[1]


def _holds(bodies: Bodies, parts: Parts, ground: float) -> Iterator[tuple[Hold, _Holds]]:
    """The hands and the seat of one person."""
    places = landmarks(bodies, parts)
    front = _smooth(facing(places))
    heading = torch.atan2(front[:, 0], front[:, 2])
    hands, hips = (_smooth(at(places, name))[:, [0, 2]] for name in ("wrists", "hips"))
    sits = postures(bodies, parts, ground).sitting
    yield "seat", _Holds(bodies.frame, hips, heading, sits)
    yield "hands", _Holds(bodies.frame, hands, heading, torch.ones_like(sits))


def _smooth(rows: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    padded = torch.cat([rows[:1], rows, rows[-1:]])
    return torch.stack([w * padded[k : k + len(rows)] for k, w in enumerate(SMOOTH)]).sum(0)


def _carried(
    piece: SceneObject, held: _Holds, start: int
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, " frames"]]:
    """Place (x, z) [m] and yaw [rad] of an object that keeps its place in a hold of one row."""
    turn = held.heading - held.heading[start]
    off = piece.t_world_object - _level(held.place[start])
    moved = (rot_y(turn) @ off)[:, [0, 2]] + held.place
    return moved, piece.yaw + turn


def _level(place: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    return torch.stack([place[0], torch.zeros_like(place[0]), place[1]])


def _fitted(
    between: Between, held: _Holds, hold: Hold, config: MoveConfig
) -> tuple[float, int, int] | None:
    """Misfit [m] and the first and last row of the hold that fits best; None: none does."""
    goal = between.after.t_world_object[[0, 2]]
    far = float((goal - between.before.t_world_object[[0, 2]]).norm())
    reach = config.reach if hold == "hands" else 0.0
    begins = _touches(between.before, held, reach)
    ends = _touches(between.after, held, reach)
    best: tuple[float, int, int] | None = None
    for first in begins.nonzero()[:, 0].tolist():
        there = _carried(between.before, held, first)[0]
        price = (there - goal).norm(dim=-1) + FRAME * (held.frame - held.frame[first])
        price[: first + 1] = torch.inf
        price[~ends] = torch.inf
        last = int(price.argmin())
        if best is None or float(price[last]) < best[0]:
            best = float(price[last]), first, last
    if best is None or best[0] == torch.inf:
        return None
    _, first, last = best
    off = float((_carried(between.before, held, first)[0][last] - goal).norm())
    return best if off <= config.loose + config.share * far else None


def _touches(piece: SceneObject, held: _Holds, reach: float) -> Bool[Tensor, " frames"]:
    """Rows in which the hold is over the footprint of an object, or within reach of it [m]."""
    places = torch.stack([_level(place) for place in held.place])
    off = beyond(box_of(piece), places).clamp_min(0).norm(dim=-1)
    return (off <= reach) & _nearly(held.able)


def _nearly(able: Bool[Tensor, " frames"]) -> Bool[Tensor, " frames"]:
    """Also the rows beside those that are able: who rolls fast is not seen to sit."""
    padded = torch.nn.functional.pad(able, (2, 2))
    return torch.stack([padded[k : k + len(able)] for k in range(5)]).any(0)


def _segments(
    between: Between, held: _Holds, first: int, last: int, person: int
) -> tuple[Segment, ...]:
    """Each frame from one row to another; rows that are missing are filled in evenly."""
    begin, end = int(held.frame[first]), int(held.frame[last])
    share = (held.frame - begin).double().clamp_min(0) / max(1, end - begin)
    share = share.clamp_max(1).to(held.place)
    (one, yaw), (other, back) = (
        _carried(piece, held, row)
        for piece, row in ((between.before, first), (between.after, last))
    )
    place = one + share[:, None] * (other - one)
    off = wrap(back - yaw)
    turned = torch.where(off.abs() < TURNED, yaw + share * off, torch.where(share < 0.5, yaw, back))
    low, high = between.before.t_world_object[1], between.after.t_world_object[1]
    found: list[Segment] = []
    for frame in range(begin + 1, end):
        row = int((held.frame <= frame).sum()) - 1
        step = int(held.frame[min(row + 1, last)] - held.frame[row])
        part = (frame - int(held.frame[row])) / max(1, step)
        x, z = (place[row] + part * (place[min(row + 1, last)] - place[row])).unbind()
        t = torch.stack([x, low + share[row] * (high - low), z])
        angle = turned[row] + part * wrap(turned[min(row + 1, last)] - turned[row])
        found.append(Segment(frame, t, wrap(angle), person))
    ready = placed_at(between.after, end)
    return (*found, Segment(end, ready.t_world_object, ready.yaw))
