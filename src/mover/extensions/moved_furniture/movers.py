r"""Furniture that moves with a person: held by hand, or sat on.

Between two stays an object is put, unseen (then it jumps), or a person moves it. The mover is found
by motion alone: a rigid hold on the hands, or on the pelvis of a sitting person, carries the object
from its position before to its position after,

    T_k = H_k H_a^{-1} T_a,   and from the other end   H_k H_b^{-1} T_b

with H_k the hold (a position on the floor and a heading) in frame k. Of all first and last frames
a, b about the time between the stays those are taken that bring it nearest to where it is found
after, with a cost for each frame; both ends are then met by going over from the first to the
second.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import BodyParts
from mover.bodies.posture import at, facing, landmarks, postures
from mover.core.records import rows_of
from mover.core.types import Bodies, SceneObject, Segment
from mover.geometry.boxes import beyond, box_of
from mover.geometry.placement import placed_at
from mover.geometry.rotations import rot_y, wrap

MARGIN = 0.8  # [s] before and after an object is seen elsewhere in which it may have been moved
REACH = 0.25  # [m] from the mover's wrists to the object's footprint, at most
LOOSE = 0.1  # [m] from where the mover brings an object to where it then stands, at most ...
SHARE = 0.25  # ... and this share of the way besides
SMOOTH = (0.25, 0.5, 0.25)  # weights of the rows before, at and after: bodies tremble
FRAME = 0.01  # [m] of misfit that another frame must save
TURNED = 0.8  # [rad]; ends that disagree by more do so by a symmetry of the object
Hold = Literal["hands", "seat"]


@dataclass(frozen=True)
class Between:
    """Two stays of an object, and when it surely stands there."""

    before: SceneObject
    after: SceneObject
    last: int  #: of the frames that surely show it where it stood before
    first: int  #: of the frames that surely show it where it stands after


@dataclass(frozen=True)
class Followed:
    """How a person moves an object."""

    person: int
    hold: Hold
    segments: tuple[Segment, ...]
    """One for each frame in which it moves, and the first of its next stay."""


@dataclass(frozen=True)
class _Holds:
    """Where a person could hold something, frame by frame."""

    frame: Int[Tensor, " frames"]
    position: Float[Tensor, "frames 2"]  #: (x, z) [m]
    heading: Float[Tensor, " frames"]  #: [rad]
    able: Bool[Tensor, " frames"]  #: whether it can be held so: the person sits


def follow_mover(
    between: Between, bodies: Bodies, parts: BodyParts, ground: float
) -> Followed | None:
    """The person who moves an object from one stay to the next; None: none is seen to do so.

    All people are in the world, whose floor is at the height `ground` [m].
    """
    if bodies.fps is None:
        return None
    margin = MARGIN * bodies.fps
    near = (bodies.frame >= between.last - margin) & (bodies.frame <= between.first + margin)
    found: list[tuple[float, Followed]] = []  # of a sitter the hands are near, too
    for person in bodies.person[near].unique().tolist():
        rows = rows_of(bodies, near & (bodies.person == person))
        rows = rows_of(rows, rows.frame.argsort())
        if len(rows.frame) < 3:
            continue
        for hold, held in _holds(rows, parts, ground):
            best = _fitted(between, held, REACH if hold == "hands" else 0.0)
            if best is not None:
                misfit, first, last = best
                moving = _segments(between, held, first, last, person)
                found.append((misfit, Followed(person, hold, moving)))
    best = min(found, key=lambda pair: (pair[1].hold != "seat", pair[0]), default=None)
    return None if best is None else best[1]


def _holds(bodies: Bodies, parts: BodyParts, ground: float) -> Iterator[tuple[Hold, _Holds]]:
    """The hands and the seat of one person."""
    points = landmarks(bodies, parts)
    front = _smooth(facing(points))
    heading = torch.atan2(front[:, 0], front[:, 2])
    hands, hips = (_smooth(at(points, name))[:, [0, 2]] for name in ("wrists", "hips"))
    sits = postures(bodies, parts, ground).sitting
    yield "seat", _Holds(bodies.frame, hips, heading, sits)
    yield "hands", _Holds(bodies.frame, hands, heading, torch.ones_like(sits))


def _smooth(rows: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    padded = torch.cat([rows[:1], rows, rows[-1:]])
    return torch.stack([w * padded[k : k + len(rows)] for k, w in enumerate(SMOOTH)]).sum(0)


def _on_floor(position: Float[Tensor, "*any 2"]) -> Float[Tensor, "*any 3"]:
    """The point (x, 0, z)."""
    x, z = position.unbind(-1)
    return torch.stack([x, torch.zeros_like(x), z], -1)


def _carried(
    piece: SceneObject, held: _Holds, start: int
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, " frames"]]:
    """Position (x, z) [m] and yaw [rad] of an object that is fixed in a hold from one row on."""
    turn = held.heading - held.heading[start]
    off = piece.t_world_object - _on_floor(held.position[start])
    moved = (rot_y(turn) @ off)[:, [0, 2]] + held.position
    return moved, piece.yaw + turn


def _fitted(between: Between, held: _Holds, reach: float) -> tuple[float, int, int] | None:
    """Misfit [m] and the first and last row of the hold that fits best; None: none does."""
    goal = between.after.t_world_object[[0, 2]]
    far = float((goal - between.before.t_world_object[[0, 2]]).norm())
    starts, ends = (_touches(one, held, reach) for one in (between.before, between.after))
    best: tuple[float, int, int] | None = None
    for first in starts.nonzero()[:, 0].tolist():
        position = _carried(between.before, held, first)[0]
        cost = (position - goal).norm(dim=-1) + FRAME * (held.frame - held.frame[first])
        cost[: first + 1] = torch.inf
        cost[~ends] = torch.inf
        last = int(cost.argmin())
        if best is None or float(cost[last]) < best[0]:
            best = float(cost[last]), first, last
    if best is None or best[0] == torch.inf:
        return None
    _, first, last = best
    off = float((_carried(between.before, held, first)[0][last] - goal).norm())
    return best if off <= LOOSE + SHARE * far else None


def _touches(piece: SceneObject, held: _Holds, reach: float) -> Bool[Tensor, " frames"]:
    """Rows in which the hold is over the footprint of an object, or within reach of it [m].

    Rows beside those of a sitting person count: who rolls fast is not seen to sit.
    """
    off = beyond(box_of(piece), _on_floor(held.position)).clamp_min(0).norm(dim=-1)
    padded = torch.nn.functional.pad(held.able, (2, 2))
    able = torch.stack([padded[k : k + len(held.able)] for k in range(5)]).any(0)
    return (off <= reach) & able


def _segments(
    between: Between, held: _Holds, first: int, last: int, person: int
) -> tuple[Segment, ...]:
    """Each frame from one row to another; rows that are missing are filled in evenly."""
    begin, end = int(held.frame[first]), int(held.frame[last])
    share = (held.frame - begin).double().clamp_min(0) / max(1, end - begin)
    share = share.clamp_max(1).to(held.position)
    (one, yaw), (other, back) = (
        _carried(piece, held, row)
        for piece, row in ((between.before, first), (between.after, last))
    )
    position = one + share[:, None] * (other - one)
    off = wrap(back - yaw)
    turned = torch.where(off.abs() < TURNED, yaw + share * off, torch.where(share < 0.5, yaw, back))
    low, high = between.before.t_world_object[1], between.after.t_world_object[1]
    found: list[Segment] = []
    for frame in range(begin + 1, end):
        row = int((held.frame <= frame).sum()) - 1
        after = min(row + 1, last)
        step = int(held.frame[after] - held.frame[row])
        part = (frame - int(held.frame[row])) / max(1, step)
        x, z = (position[row] + part * (position[after] - position[row])).unbind()
        t = torch.stack([x, low + share[row] * (high - low), z])
        angle = turned[row] + part * wrap(turned[after] - turned[row])
        found.append(Segment(frame, t, wrap(angle), person))
    ready = placed_at(between.after, end)
    return (*found, Segment(end, ready.t_world_object, ready.yaw))
