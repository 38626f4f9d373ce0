"""Known rooms in which a piece of furniture is moved while the room is empty.

Two rooms that differ in the place of one piece, each with a visitor of its own, become one video:
the second visitor comes after the piece was moved. How the objects look in the frames is known, as
a segmenter that tracks them would give it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch

from mover.core.types import People, Scene, Segment
from mover.geometry.rle import decode, joined
from mover.io.capture.pose_file import joined_bodies
from mover_bench.rooms.compose import Plan, fits, in_view
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import (
    KnownRoom,
    NoRoomError,
    RefusedError,
    build,
    cast,
    make_room,
    one_thread,
)
from mover_bench.rooms.placed import Placed
from mover_bench.rooms.render import encode, see

MOVABLE = ("chair", "office chair", "stool", "armchair", "table", "coffee table")
GAP = 10  # frames in which the room is empty, and in the middle of which the piece is moved
EVERY = 2  # frames from one in which the objects are segmented to the next
FAR = (0.5, 1.6)  # [m] by which a piece is moved
TURN = 60.0  # [degrees] by which it is turned, at most
TRIES = 60
Rows = TypeVar("Rows")


@one_thread()
def make_moved_room(seed: int, config: RoomConfig) -> KnownRoom:
    """A room in which the piece that is used most, of those that can be moved, is moved.

    Raises:
        NoRoomError: If no piece of the room can be moved.
    """
    first = make_room(seed, config)
    rng = np.random.default_rng([seed, 77])
    refused: list[str] = []
    used = [int((first.touched == k).any(1).sum()) for k in range(len(first.furniture))]
    movable = [k for k, piece in enumerate(first.furniture) if piece.category in MOVABLE]
    for index in sorted(movable, key=lambda k: -used[k]):
        for _ in range(TRIES // 10):
            try:
                plan = _moved(first.plan, index, rng)
                acts = cast(plan, config, rng, refused)
                second = build(plan, acts, config, first.capture.name, ())
                return _joined(first, second, index)
            except RefusedError as error:
                refused.append(str(error))
    raise NoRoomError(f"seed {seed}: nothing can be moved: {refused[-3:]}")


def _moved(plan: Plan, index: int, rng: np.random.Generator) -> Plan:
    """The plan with one piece elsewhere, free and in view."""
    piece = plan.pieces[index]
    others = [p for k, p in enumerate(plan.pieces) if k != index]
    for _ in range(TRIES):
        way, far = rng.uniform(-np.pi, np.pi), rng.uniform(*FAR)
        x, z = piece.place + far * np.array([math.sin(way), math.cos(way)])
        turn = math.radians(float(rng.uniform(-TURN, TURN)))
        there = Placed(piece.id, piece.furniture, (float(x), float(z)), piece.heading + turn)
        if fits(there, others, 0.3, plan.walls) and in_view(there, plan.view) >= 0.95:
            pieces = tuple(there if k == index else p for k, p in enumerate(plan.pieces))
            return replace(plan, pieces=pieces)
    raise RefusedError(f"{piece.id} has nowhere to go")


def _joined(first: KnownRoom, second: KnownRoom, index: int) -> KnownRoom:
    """One video of both."""
    later = int(first.bodies.frame.max()) + 1 + GAP
    change, people = later - GAP // 2, 1 + int(first.bodies.person.max())
    second = replace(
        second,
        bodies=_shifted(second.bodies, later, people),
        capture=replace(second.capture, people=_shifted(second.capture.people, later, people)),
    )
    end = int(second.bodies.frame.max()) + 1
    before, after = range(0, change, EVERY), range(change + change % EVERY, end, EVERY)
    truth = _scene(first.truth, second.truth, index, change)
    rooms = first, second
    bodies = joined_bodies([room.bodies for room in rooms])
    capture = replace(
        first.capture,
        bodies=bodies,
        people=joined_people([room.capture.people for room in rooms if room.capture.people]),
        furniture=joined_people([_seen(first, before), _seen(second, after)]),
    )
    names = ("touching", "touched", "whole")
    rows = {name: torch.cat([getattr(room, name) for room in rooms]) for name in names}
    actions = (*first.actions, *second.actions)
    return replace(first, **rows, bodies=bodies, capture=capture, truth=truth, actions=actions)


def _shifted(rows: Rows, frames: int, people: int) -> Rows:
    """The same later, and other people."""
    moved: Any = rows
    return replace(moved, frame=moved.frame + frames, person=moved.person + people)


def joined_people(parts: Sequence[People]) -> People:
    """The rows of all masks, one after the other."""
    frame, person = (torch.cat([getattr(p, name) for p in parts]) for name in ("frame", "person"))
    return People(joined([p.masks for p in parts]), frame, person, parts[0].heights)


def _seen(room: KnownRoom, frames: range) -> People:
    """Masks of the objects in some frames; `person` is the number of the annotation."""
    people, objects = room.capture.people, see(room.plan).piece
    assert people is not None, "a known room has masks"
    rows: list[tuple[int, int]] = []
    masks: list[np.ndarray] = []
    for frame in frames:
        shown = objects.clone()
        for row in (people.frame == frame).nonzero()[:, 0].tolist():
            shown[decode(people.masks, row)] = -1
        for index in shown.unique().tolist():
            if index >= 0:
                rows.append((frame, index + 1))
                masks.append((shown == index).numpy())
    frame, number = torch.tensor(rows).unbind(1)
    return People(encode(masks), frame, number, {})


def _scene(first: Scene, second: Scene, index: int, change: int) -> Scene:
    """The first scene; one piece of it stands elsewhere from a frame on."""
    segments = tuple(
        Segment(frame, scene.objects[index].t_world_object, scene.objects[index].yaw)
        for frame, scene in ((0, first), (change, second))
    )
    pieces = list(first.objects)
    pieces[index] = replace(pieces[index], segments=segments)
    return replace(first, objects=tuple(pieces))
