"""What people do in a room: a list of tasks becomes a performance, checked against the furniture.

A task that would sink into furniture, or hang in the air where it should touch, is refused and
left out; the reasons are kept.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float

from mover.core.records import record
from mover.geometry.warp_start import mapped
from mover_bench.rooms import resting
from mover_bench.rooms.gait import duration, stations, walk
from mover_bench.rooms.placed import NoWayError, Placed, way
from mover_bench.rooms.poses import SIDES, Person, Posture, blend, chain, facing, rows, smooth
from mover_bench.rooms.truth import faults

DOOR = 0.3  # [m], from a seat or table to where one turns round


@record
class Task:
    """One thing to do."""

    kind: Literal["walk", "sit", "lean", "lie", "table"]
    piece: int = -1  #: index of the piece; -1 for a walk
    goal: tuple[float, float] = (0.0, 0.0)  #: where to walk (x, z) [m]
    seconds: float = 5.0  #: how long to stay [s]
    side: int = 1  #: lying: from which side; at a table: 0 front, 1 left, 2 back, 3 right
    along: float = 0.0  #: offset along the edge [m]
    roll: bool = False  #: lying: turn onto the side and back


@record
class Take:
    """Frames of one kind of action."""

    posture: Posture
    label: str
    piece: int


@record
class Stop:
    """Where a task is done: in front of a seat, at a table, or anywhere."""

    place: Float[np.ndarray, "2"]
    heading: float
    door: Float[np.ndarray, "2"]  #: where one turns before and after


@record
class Stage:
    """Everything that a performance needs to know."""

    person: Person
    pieces: tuple[Placed, ...]
    bounds: Float[np.ndarray, "2 2"]  #: smallest and largest x and z that one may walk [m]
    fps: float


@record
class Performance:
    """One person's frames."""

    posture: Posture
    labels: tuple[str, ...]
    touched: tuple[int, ...]  #: index of the piece in use in each frame, or -1
    refused: tuple[str, ...]


def perform(
    stage: Stage, tasks: tuple[Task, ...], start: Stop, rng: np.random.Generator, enough: int = 0
) -> Performance:
    """Do the tasks one after the other; refuse those that the furniture does not allow.

    After `enough` frames no further task is started, unless that is 0.
    """
    takes: list[Take] = []
    refused: list[str] = []
    here = start
    for task in tasks:
        phase = float(rng.uniform(0, 2 * np.pi))
        if enough and sum(len(take.posture.pelvis) for take in takes) >= enough:
            break
        try:
            stop = stop_for(stage, task, here)
            new = _played(stage, task, here, stop, phase)
        except (NoWayError, ValueError) as error:
            name = stage.pieces[task.piece].id if task.piece >= 0 else "to a place"
            refused.append(f"{task.kind} {name}: {error}")
        else:
            takes, here = takes + new, stop
    if not takes:
        takes = [Take(resting.standing(stage.person, start.place, start.heading), "walk", -1)]
    count = [len(t.posture.pelvis) for t in takes]
    labels = tuple(t.label for t, n in zip(takes, count, strict=True) for _ in range(n))
    touched = tuple(t.piece for t, n in zip(takes, count, strict=True) for _ in range(n))
    return Performance(chain([t.posture for t in takes]), labels, touched, tuple(refused))


def _played(stage: Stage, task: Task, here: Stop, stop: Stop, phase: float) -> list[Take]:
    """Walk there and do it, checked against the furniture."""
    path = way(here.door, stop.door, stage.pieces, stage.bounds)
    route = stations(path, here.heading, stop.heading, np.stack([here.place, stop.place]))
    walked = Take(walk(stage.person, route, _times(stage, duration(route))), "walk", -1)
    _check(stage, [walked])
    acts = _ACTS[task.kind](stage, task, stop, phase)
    _check(stage, acts)
    return [walked, *acts]


def _check(stage: Stage, takes: list[Take]) -> None:
    def wrong(take: Take) -> list[str]:
        return faults(stage.person, take.posture, take.label, stage.pieces, take.piece)

    found = [fault for faulty in mapped(wrong, takes) for fault in faulty]
    if found:
        raise ValueError(found[0])


def stop_for(stage: Stage, task: Task, here: Stop) -> Stop:
    """Where a task is done."""
    if task.kind == "walk":
        goal = np.array(task.goal)
        ahead = goal - here.place
        return Stop(goal, float(np.arctan2(ahead[0], ahead[1])), goal)
    if task.kind == "table":
        place, heading = resting.table_stand(stage.pieces, task.piece, task.side, task.along)
        return Stop(place, heading, place - DOOR * facing(np.array(heading)))
    spot = resting.seat_spot(stage.pieces, task.piece, task.along)
    if task.kind == "lie":
        spot = resting.berth(stage.person, stage.pieces, task.piece, task.side).spot
    place = resting.before(stage.person, spot)
    return Stop(place, spot.heading, place + DOOR * facing(np.array(spot.heading)))


def _times(stage: Stage, seconds: float) -> Float[np.ndarray, " frames"]:
    return np.arange(1, max(1, round(seconds * stage.fps)) + 1) / stage.fps


def _shares(stage: Stage, seconds: float) -> Float[np.ndarray, " frames"]:
    times = _times(stage, seconds)
    return times / times[-1]


def _still(stage: Stage, posture: Posture, seconds: float, phase: float, amount: float) -> Posture:
    return resting.settle_down(posture, _times(stage, seconds), phase, amount)


def _sit(stage: Stage, task: Task, stop: Stop, phase: float) -> list[Take]:
    piece = stage.pieces[task.piece]
    spot = resting.seat_spot(stage.pieces, task.piece, task.along)
    sitting = resting.seated(stage.person, spot, piece)
    down = resting.sit_down(stage.person, sitting, stop.heading, _shares(stage, resting.SIT_TIME))
    if task.kind == "sit":
        parts = [("sit", _still(stage, sitting, task.seconds, phase, 1.0))]
    else:
        back = resting.leaning(stage.person, sitting, piece)
        move = blend(sitting, back, smooth(_shares(stage, 1.0)))
        parts = [
            ("sit", _still(stage, sitting, 1.6, phase, 1.0)), ("sit", move),
            ("lean", _still(stage, back, task.seconds, phase, 0.0)), ("sit", _reversed(move)),
        ]  # fmt: skip
    parts = [("sit down", down), *parts, ("stand up", _reversed(down))]
    return [Take(posture, label, task.piece) for label, posture in parts]


def _lie(stage: Stage, task: Task, stop: Stop, phase: float) -> list[Take]:
    person, piece = stage.person, stage.pieces[task.piece]
    place = resting.berth(person, stage.pieces, task.piece, task.side)
    sitting = resting.seated(person, place.spot, piece)
    back = resting.supine(person, place, piece)
    down = resting.sit_down(person, sitting, stop.heading, _shares(stage, resting.SIT_TIME))
    lay = resting.lie_down(person, sitting, back, piece, _shares(stage, resting.LIE_TIME))
    parts = [
        ("sit down", down), ("sit", _still(stage, sitting, 1.0, phase, 1.0)), ("lie down", lay),
        ("lie", _still(stage, back, task.seconds, phase, 0.0)),
    ]  # fmt: skip
    if task.roll:
        side = resting.on_side(person, back, place, piece)
        roll = resting.roll_over(person, back, side, piece, _shares(stage, 2.0))
        rest = _still(stage, rows(roll, slice(-1, None)), 0.6 * task.seconds, phase, 0.0)
        parts += [("lie", roll), ("lie", rest), ("lie", _reversed(roll))]
    parts += [("get up", _reversed(lay)), ("stand up", _reversed(down))]
    return [Take(posture, label, task.piece) for label, posture in parts]


def _table(stage: Stage, task: Task, stop: Stop, phase: float) -> list[Take]:
    hand = int(phase > np.pi)
    end = resting.hand_on(stage.person, stop.place, stop.heading, stage.pieces[task.piece], hand)
    stand = resting.standing(stage.person, stop.place, stop.heading)
    out = resting.reach_out(end, stand, _shares(stage, resting.REACH_TIME))
    still = _still(stage, end, task.seconds, phase, 0.3)
    parts = [("reach", out), (f"{SIDES[hand]} hand", still), ("reach", _reversed(out))]
    return [Take(posture, label, task.piece) for label, posture in parts]


def _reversed(posture: Posture) -> Posture:
    """The same frames from the last to the first, without the last."""
    order = np.maximum(np.arange(len(posture.pelvis)) - 1, 0)[::-1]
    return rows(posture, order)


_ACTS = {"walk": lambda *_: [], "sit": _sit, "lean": _sit, "lie": _lie, "table": _table}
