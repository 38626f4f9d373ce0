"""Known rooms in which somebody moves a piece of furniture: pushes it, or rolls on it.

Who pushes holds an edge with both hands, and the piece keeps its place before the body; who rolls
sits, and body and seat move as one. Where the piece stands is known in each frame.
"""

import dataclasses

import numpy as np
import torch

from mover.core.records import record
from mover.core.types import Scene, Segment
from mover_bench.rooms.compose import Plan, fits, in_view
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.gait import Stations, duration, route_of, stations, walk
from mover_bench.rooms.known import (
    Actor,
    KnownRoom,
    RefusedError,
    build,
    looks,
    one_thread,
    pieces_seen,
)
from mover_bench.rooms.motion import (
    DOOR,
    Stage,
    Stop,
    Take,
    Task,
    done_there,
    in_turn,
    perform,
    stop_for,
    walk_to,
)
from mover_bench.rooms.moved import EVERY, candidates, first_draft
from mover_bench.rooms.placed import BODY, Placed, free_of
from mover_bench.rooms.poses import Person, Posture, blend, make_person, rows
from mover_bench.rooms.render import see
from mover_bench.rooms.room import draw_person, draw_start, draw_tasks
from mover_bench.rooms.seating import palm_height, span, standing
from mover_bench.rooms.truth import PRESS
from mover_bench.rooms.turns import Y, about, apply, facing, left_of, smooth

PUSHED = ("chair", "office chair", "armchair", "table")
ROLLED = ("office chair", "chair", "stool")
TRIES = 12  # drafts with each piece of a room
GRASP = 0.4  # [m], from the edge that is held to the middle of the body
HOLD = (0.6, 1.15)  # [m], heights at which an edge is held
PALM = 0.07  # [m], from the wrist to the middle of the hand
GRIP_TIME = 1.0  # [s]
FAR = {"pushed": (0.6, 1.6), "rolled": (0.4, 1.0)}  # [m]
ASIDE = np.radians(35)  # how far from straight ahead one pushes
TURN = np.radians(60)  # how far a seat is turned, at most
ROLL_SPEED = 0.4  # [m/s], in the mean
SET_OUT = 0.01  # [m], what is nearer to where it stood stands


@record
class Handled:
    """What is done with a piece, and where it is meanwhile."""

    takes: tuple[Take, ...]
    places: tuple[Placed, ...]
    """Of the piece in each frame of the takes."""
    stop: Stop
    """Where the person ends."""


@one_thread()
def make_handled_room(seed: int, config: RoomConfig) -> KnownRoom:
    """A room whose visitor pushes the piece that is used most, or rolls on it.

    Raises:
        NoRoomError: If no piece of the room can be moved so.
    """
    rng = np.random.default_rng([seed, 78])
    kinds = ROLLED if config.moved == "rolled" else PUSHED

    def draft(plan: Plan, index: int) -> KnownRoom:
        return _acted(plan, index, config, rng)

    return first_draft(
        seed, config, lambda room: candidates(room, kinds), draft, TRIES, "nothing can be moved"
    )


def _acted(plan: Plan, index: int, config: RoomConfig, rng: np.random.Generator) -> KnownRoom:
    """One draft of the room."""
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    stage = Stage(make_person(draw_person(rng)), plan.pieces, bounds, config.fps)
    tasks = draw_tasks(plan, rng, config.stay, config.acts)
    before = perform(stage, tasks, draw_start(plan, rng), rng)
    assert before.stop is not None, "a performance ends somewhere"
    act = _roll if config.moved == "rolled" else _push
    handled = act(stage, index, before.stop, rng)
    _check(plan, handled.places)
    end = handled.places[-1]
    pieces = tuple(end if k == index else p for k, p in enumerate(plan.pieces))
    later = dataclasses.replace(plan, pieces=pieces)
    tasks = draw_tasks(later, rng, config.stay, config.acts)
    last = dataclasses.replace(stage, pieces=pieces)
    after = perform(last, (*tasks, Task("sit", index, seconds=4.0)), handled.stop, rng)
    start, held = len(before.labels), len(handled.places)
    moving = {start + k: place for k, place in enumerate(handled.places)}
    moving |= {start + held + k: end for k in range(len(after.labels))}
    whole = in_turn(before, handled.takes, after)
    room = build(plan, (Actor(stage, whole),), config, f"{config.moved}", whole.refused, moving)
    truth = _scene(room, index, moving)
    seen = looks(plan, moving, see(plan))
    frames = range(0, len(whole.labels), EVERY)
    furniture = pieces_seen(room.capture.people, frames, lambda frame: seen(frame)[1])
    capture = dataclasses.replace(room.capture, furniture=furniture)
    return dataclasses.replace(room, capture=capture, truth=truth)


def _check(plan: Plan, places: tuple[Placed, ...]) -> None:
    """Whether a piece is free on all of its way, and in view at its end."""
    others = [piece for piece in plan.pieces if piece.id != places[0].id]
    near = {piece.id for piece in others if not fits(places[0], [piece], 0.02, plan.walls)}
    others = [piece for piece in others if piece.id not in near]
    if not all(fits(place, others, 0.02, plan.walls) for place in places):
        raise RefusedError(f"{places[0].id}: something stands in the way")
    if near and not fits(places[-1], list(plan.pieces), 0.1, plan.walls):
        raise RefusedError(f"{places[0].id}: something stands in the way")
    if in_view(places[-1], plan.view) < 0.95:
        raise RefusedError(f"{places[0].id} leaves the view")


def _scene(room: KnownRoom, index: int, moving: dict[int, Placed]) -> Scene:
    """The true scene: the piece is at a place of its own in each frame in which it moves."""
    piece, first = room.truth.objects[index], room.plan.pieces[index]
    end = moving[max(moving)]

    def far(place: Placed, other: Placed) -> bool:
        return float(np.hypot(*(place.place - other.place))) >= SET_OUT

    begin = min(frame for frame, place in moving.items() if far(place, first))
    ready = max(frame for frame, place in moving.items() if far(place, end)) + 1
    height = float(piece.t_world_object[1])
    stays = Segment(0, piece.t_world_object, piece.yaw), _segment(ready, end, height, None)
    held = [_segment(frame, moving[frame], height, 0) for frame in range(begin, ready)]
    piece = dataclasses.replace(piece, segments=(stays[0], *held, stays[1]))
    objects = tuple(piece if k == index else p for k, p in enumerate(room.truth.objects))
    return dataclasses.replace(room.truth, objects=objects)


def _segment(frame: int, place: Placed, height: float, mover: int | None) -> Segment:
    """Where a piece is from a frame on."""
    at = torch.tensor([place.at[0], height, place.at[1]])
    return Segment(frame, at, torch.tensor(float(place.heading)), mover)


# Rolling: a sitter and the seat move as one.


def _roll(stage: Stage, index: int, here: Stop, rng: np.random.Generator) -> Handled:
    """Sit down, roll elsewhere, sit there, stand up."""
    piece, later = stage.pieces[index], _elsewhere(stage.pieces[index], rng)
    way = np.hypot(*(later.place - piece.place))
    count = max(2, round(way / ROLL_SPEED * stage.fps))
    share = smooth(np.arange(1, count + 1) / count)
    places = tuple(_between(piece, later, float(part)) for part in share)
    task = Task("sit", index, seconds=3.0)
    stop = stop_for(stage, task, here)
    walked, (down, sit, _) = walk_to(stage, here, stop), done_there(stage, task, stop)
    pieces = tuple(later if k == index else p for k, p in enumerate(stage.pieces))
    there = dataclasses.replace(stage, pieces=pieces)
    stop = stop_for(there, task, here)
    _, rest, up = done_there(there, task, stop)
    rolled = _rigid(rows(sit.posture, np.full(count, -1)), piece, places)
    takes = (walked, down, sit, Take(rolled, "roll", index), rest, up)
    counts = [len(take.posture.pelvis) for take in takes]
    stands = (piece,) * sum(counts[:3])
    return Handled(takes, (*stands, *places, *(places[-1:] * sum(counts[4:]))), stop)


def _elsewhere(piece: Placed, rng: np.random.Generator) -> Placed:
    """A place to which a sitter rolls."""
    way, far = rng.uniform(-np.pi, np.pi), rng.uniform(*FAR["rolled"])
    x, z = piece.place + far * facing(np.array(way))
    turn = float(rng.uniform(-TURN, TURN))
    return dataclasses.replace(piece, at=(float(x), float(z)), heading=piece.heading + turn)


def _between(start: Placed, end: Placed, share: float) -> Placed:
    """A place on the way."""
    x, z = (1 - share) * start.place + share * end.place
    heading = (1 - share) * start.heading + share * end.heading
    return dataclasses.replace(start, at=(float(x), float(z)), heading=heading)


def _rigid(posture: Posture, start: Placed, places: tuple[Placed, ...]) -> Posture:
    """A body that keeps its place on a piece, which is at another one in each frame."""
    turn = _turns(start, places)
    pelvis = _carried(posture.pelvis[:, None], start, places)[:, 0]
    return dataclasses.replace(
        posture, pelvis=pelvis, turn=turn @ posture.turn,
        ankles=_carried(posture.ankles, start, places),
        feet=turn[:, None] @ posture.feet, knees=apply(turn[:, None], posture.knees),
    )  # fmt: skip


# Pushing: both hands hold an edge; the piece keeps its place before the body.


def _push(stage: Stage, index: int, here: Stop, rng: np.random.Generator) -> Handled:
    """Walk behind a piece, take hold of it, push it elsewhere, let go."""
    piece = stage.pieces[index]
    heading = piece.heading
    if piece.furniture.back_height == 0:
        heading += float(rng.integers(4)) * np.pi / 2
    grips = _grips(stage.person, piece, heading)
    place = grips.mean(0)[[0, 2]] - GRASP * facing(np.array(heading))
    stop = Stop(place, heading, place - DOOR * facing(np.array(heading)))
    walked = walk_to(stage, here, stop)
    way = _way(stage, index, stop, rng)
    times = np.arange(1, round(duration(way) * stage.fps) + 1) / stage.fps
    route = route_of(way)(times)
    start = np.array([*place, heading])
    places = tuple(_before(piece, start, now) for now in route)
    bend = _bend(stage.person, standing(stage.person, place, heading), grips)
    pushing = _holding(walk(stage.person, way, times), bend, _carried(grips, piece, places))
    still = [standing(stage.person, row[:2], float(row[2])) for row in (start, route[-1])]
    share = np.arange(1, round(GRIP_TIME * stage.fps) + 1) / (GRIP_TIME * stage.fps)
    ends = [_holding(still[0], bend, grips[None]), rows(pushing, slice(-1, None))]
    free = [dataclasses.replace(s, palms=e.palms) for s, e in zip(still, ends, strict=True)]
    takes = (
        walked, Take(blend(free[0], ends[0], smooth(share)), "reach", index),
        Take(pushing, "push", index), Take(blend(ends[1], free[1], smooth(share)), "reach", index),
    )  # fmt: skip
    counts = [len(take.posture.pelvis) for take in takes]
    stands = (piece,) * sum(counts[:2])
    x, z, last = route[-1]
    end = np.array([x, z])
    door = end - DOOR * facing(np.array(last))
    return Handled(
        takes,
        (*stands, *places, *(places[-1:] * counts[3])),
        Stop(end, float(last), door),
    )


def _way(stage: Stage, index: int, stop: Stop, rng: np.random.Generator) -> Stations:
    """A straight way of who pushes, more or less ahead."""
    aim = stop.heading + float(rng.uniform(-ASIDE, ASIDE))
    far = float(rng.uniform(*FAR["pushed"]))
    path = np.stack([stop.place, stop.place + far * facing(np.array(aim))])
    others = tuple(p for k, p in enumerate(stage.pieces) if k != index)
    if not free_of(np.linspace(path[0], path[1], 20), others, BODY).all():
        raise RefusedError(f"nobody can walk behind {stage.pieces[index].id}")
    return stations(path, stop.heading, aim)


def _grips(person: Person, piece: Placed, heading: float) -> np.ndarray:
    """Where the wrists are when both hands hold the edge that is nearest to the body [m]."""
    height = piece.furniture.back_height or piece.furniture.top_height
    if not HOLD[0] < height < HOLD[1]:
        raise RefusedError(f"{piece.id} cannot be held at {height:.2f} m")
    verts = piece.furniture.mesh.verts.double().numpy()
    top = verts[np.abs(verts[:, 1] - height) < 0.06]
    turn = about(Y, np.array(piece.heading))
    top = apply(turn, top)
    ahead, left = facing(np.array(heading)), left_of(np.array(heading))
    along, aside = top[:, [0, 2]] @ ahead, top[:, [0, 2]] @ left
    edge = float(along.min()) + min(0.05, float(np.ptp(along)) / 2) - PALM
    wide = min(0.2, float(np.abs(aside[along < along.min() + 0.1]).max()) - 0.04)
    flat = piece.place + edge * ahead
    level = height + palm_height(person) - PRESS
    both = [flat + wide * left, flat - wide * left]
    return np.array([[x, level, z] for x, z in both])


def _before(piece: Placed, start: np.ndarray, now: np.ndarray) -> Placed:
    """A piece that keeps its place before a body that went from one (x, z, heading) to another."""
    turn = float(now[2] - start[2])
    off = np.array([piece.at[0] - start[0], 0.0, piece.at[1] - start[1]])
    x, _, z = apply(about(Y, np.array(turn)), off) + np.array([now[0], 0.0, now[1]])
    return dataclasses.replace(piece, at=(float(x), float(z)), heading=piece.heading + turn)


def _turns(start: Placed, places: tuple[Placed, ...]) -> np.ndarray:
    """How far a piece is turned in each frame."""
    return about(Y, np.array([place.heading - start.heading for place in places]))


def _carried(points: np.ndarray, start: Placed, places: tuple[Placed, ...]) -> np.ndarray:
    """Points, of each frame or of all alike, that keep their places on a piece [m]."""
    old = np.array([start.at[0], 0.0, start.at[1]])
    new = np.array([[place.at[0], 0.0, place.at[1]] for place in places])
    return apply(_turns(start, places)[:, None], points - old) + new[:, None]


def _holding(posture: Posture, bend: float, palms: np.ndarray) -> Posture:
    """The same with the trunk bent forward [rad] and both hands on their places."""
    spine = posture.spine + np.array([bend, 0.0, 0.0])
    head = posture.head - np.array([0.4 * bend, 0.0])
    resting = np.ones((len(posture.pelvis), 2))
    return dataclasses.replace(posture, spine=spine, head=head, palms=palms, resting=resting)


def _bend(person: Person, stand: Posture, grips: np.ndarray) -> float:
    """How far one bends to reach both places [rad]."""
    for angle in np.arange(0.0, 1.0, 0.02):
        bent = dataclasses.replace(stand, spine=stand.spine + np.array([[angle, 0.0, 0.0]]))
        if all(span(person, bent, k, grips[k]) < 0.93 * person.arm for k in (0, 1)):
            return float(angle)
    raise RefusedError("arms are too short to hold it")
