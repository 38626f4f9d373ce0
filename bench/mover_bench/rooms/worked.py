"""Known rooms in which people work at a table: one sits at it, another leans on it.

Both lay their palms on its top. Who sits is there when the video begins and is not seen to leave;
who stands comes between other uses of the room.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from mover.furniture.library import make_piece
from mover_bench.rooms.compose import Plan, fits, in_view
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import Actor, KnownRoom, build, one_thread
from mover_bench.rooms.motion import (
    DOOR,
    Performance,
    RefusedTaskError,
    Stage,
    Stop,
    Take,
    in_turn,
    perform,
    there_and_back,
    walk_to,
)
from mover_bench.rooms.moved import candidates, first_draft
from mover_bench.rooms.placed import Placed
from mover_bench.rooms.poses import Person, Posture, make_person
from mover_bench.rooms.room import draw_person, draw_start, draw_tasks, late
from mover_bench.rooms.seating import (
    AWAY,
    HANDS,
    bent_over,
    palm_height,
    seat_spot,
    seated,
    settle_down,
    span,
    standing,
    table_stand,
)
from mover_bench.rooms.truth import approach, faults, gap
from mover_bench.rooms.turns import facing, left_of

TABLES, KNEES = ("table", "desk", "cabinet"), ("table", "desk")  # those with room for knees
CHAIRS = ("chair", "office chair", "stool")
HIGH = (0.65, 1.0)  # [m], of a top that one works at
LABEL = "both hands"
SECONDS = (4.0, 6.0)  # [s] of work
PART = (0.14, 0.22)  # [m], of each hand to the side
INSIDE = (0.06, 0.18)  # [m], from the edge to the wrists
TUCKED = (-0.08, 0.1)  # [m], from a table's edge to that of a seat before it
MOST_BEND = 0.7  # [rad] of who sits
TRIES = 12


@one_thread()
def make_worked_room(seed: int, config: RoomConfig) -> KnownRoom:
    """The room of a seed, at one of whose tables people work.

    Raises:
        NoRoomError: If nobody can work at any table of it.
    """
    rng = np.random.default_rng([seed, 80])

    def tables(room: KnownRoom) -> list[int]:
        found = candidates(room, TABLES)
        return [k for k in found if HIGH[0] < room.furniture[k].top_height < HIGH[1]]

    def draft(plan: Plan, index: int) -> KnownRoom:
        return _worked(plan, index, config, rng)

    return first_draft(seed, config, tables, draft, TRIES, "nobody can work")


def _worked(plan: Plan, index: int, config: RoomConfig, rng: np.random.Generator) -> KnownRoom:
    """One draft of the room; without who sits where no seat fits before the table."""
    sitter = None
    if plan.pieces[index].furniture.category in KNEES:
        sitter = _at_work(plan, index, config, rng)
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    pieces = plan.pieces if sitter is None else sitter.stage.pieces
    plan = dataclasses.replace(plan, pieces=pieces)
    stage = Stage(make_person(draw_person(rng)), pieces, bounds, config.fps)
    visitor = Actor(stage, _visit(plan, stage, index, config, rng))
    if sitter is None:
        return build(plan, (visitor,), config, "worked", ())
    wait = len(sitter.performance.labels)
    visitor = dataclasses.replace(visitor, performance=late(visitor.performance, wait))
    return build(plan, (sitter, visitor), config, "worked", ())


def _visit(
    plan: Plan, stage: Stage, index: int, config: RoomConfig, rng: np.random.Generator
) -> Performance:
    """Somebody does random things, leans on the table, and does others."""
    tasks = draw_tasks(plan, rng, config.stay, config.acts)
    half = len(tasks) // 2
    before = perform(stage, tasks[:half], draw_start(plan, rng), rng)
    assert before.stop is not None, "a performance ends somewhere"
    place, heading = table_stand(plan.pieces, index, *_spot(plan.pieces[index], rng))
    stop = Stop(place, heading, place - DOOR * facing(np.array(heading)))
    takes = [walk_to(stage, before.stop, stop), *_leans(stage, index, stop, rng)]
    return in_turn(before, takes, perform(stage, tasks[half:], stop, rng))


def _spot(piece: Placed, rng: np.random.Generator) -> tuple[int, float]:
    """A side of a piece, and how far from its middle, where both hands find the top [m]."""
    width, _, depth = piece.furniture.size
    side = int(rng.integers(4)) if piece.furniture.category == "table" else 0
    free = max(0.0, (width if side % 2 == 0 else depth) / 2 - 0.35)
    return side, float(rng.uniform(-free, free))


def _leans(stage: Stage, index: int, stop: Stop, rng: np.random.Generator) -> list[Take]:
    """Standing, both palms on a top, and back."""
    stand = standing(stage.person, stop.place, stop.heading)

    def bent(angle: float) -> Posture:
        return bent_over(stand, stop.heading, angle)

    flat = _palms(stop.place + AWAY * facing(np.array(stop.heading)), stop.heading, rng)
    end = both_on(stage.person, bent, flat, stage.pieces[index])
    takes = there_and_back(stage, stop, end, Take(_still(end, stage.fps, rng), LABEL, index))
    _check(stage, takes)
    return takes


def _at_work(plan: Plan, index: int, config: RoomConfig, rng: np.random.Generator) -> Actor | None:
    """Somebody who sits before a table on a seat of its own; None: no seat fits."""
    table, fps = plan.pieces[index], config.fps
    name = CHAIRS[int(rng.integers(len(CHAIRS)))]
    for _ in range(TRIES):
        chair, side = make_piece(name, rng), _spot(table, rng)
        edge, heading = table_stand(plan.pieces, index, *side)
        ahead = facing(np.array(heading))
        edge = edge + AWAY * ahead
        middle = edge - (float(rng.uniform(*TUCKED)) + chair.seat_front) * ahead
        seat = Placed(f"{name.replace(' ', '_')}_work", chair, (middle[0], middle[1]), heading)
        others = [piece for piece in plan.pieces if piece.id != table.id]
        if not fits(seat, others, 0.2, plan.walls) or in_view(seat, plan.view) < 0.85:
            continue
        pieces = (*plan.pieces, seat)
        stage = Stage(make_person(draw_person(rng)), pieces, np.zeros((2, 2)), fps)
        flat = _palms(edge, heading, rng)
        try:
            posture = _still(_typing(stage, len(pieces) - 1, index, flat), fps, rng)
            _check(stage, [Take(posture, LABEL, index)])
        except (RefusedTaskError, ValueError):
            continue
        count = len(posture.pelvis)
        return Actor(stage, Performance(posture, (LABEL,) * count, (index,) * count, ()))
    return None


def _typing(stage: Stage, seat: int, table: int, flat: np.ndarray) -> Posture:
    """One frame of sitting with both palms on a table, as upright as they allow."""
    sits = seated(stage.person, seat_spot(stage.pieces, seat), stage.pieces[seat])

    def bent(angle: float) -> Posture:
        spine = sits.spine + np.array([[angle, 0, 0]])
        return dataclasses.replace(sits, spine=spine, head=np.array([[0.2 - 0.4 * angle, 0.0]]))

    return both_on(stage.person, bent, flat, stage.pieces[table], MOST_BEND)


def _palms(edge: np.ndarray, heading: float, rng: np.random.Generator) -> np.ndarray:
    """Where the left and the right wrist rest behind a point of an edge (x, z) [m]."""
    middle = edge + float(rng.uniform(*INSIDE)) * facing(np.array(heading))
    aside = left_of(np.array(heading)) * float(rng.uniform(*PART))
    return np.stack([middle + aside, middle - aside])


def both_on(
    person: Person,
    bent: Callable[[float], Posture],
    flat: np.ndarray,
    piece: Placed,
    most: float = 1.0,
) -> Posture:
    """One frame with both palms on a top, bent as little as they allow, at most so far [rad].

    Raises:
        ValueError: If the arms are too short.
    """
    high = np.full(2, piece.furniture.top_height + palm_height(person))
    goals = np.stack([flat[:, 0], high, flat[:, 1]], -1)
    angle = 0.0
    while any(span(person, bent(angle), k, goals[k]) > 0.975 * person.arm for k in range(2)):
        angle += 0.02
        if angle > most:
            raise ValueError("the table is out of reach")
    palms = goals[None] + np.array([0.0, 0.06, 0.0])

    def touching(hand: int, rise: float) -> Posture:
        palms[0, hand, 1] = high[hand] + rise
        return dataclasses.replace(bent(angle), palms=palms.copy(), resting=np.ones((1, 2)))

    for hand, name in enumerate(HANDS):

        def above(rise: float, hand: int = hand, name: str = name) -> float:
            return gap(person, touching(hand, rise), piece, name)

        touching(hand, approach(above, 0.06, -1.0, 0.1))
    return dataclasses.replace(bent(angle), palms=palms, resting=np.ones((1, 2)))


def _still(posture: Posture, fps: float, rng: np.random.Generator) -> Posture:
    """The same for some seconds, with small movements."""
    times = np.arange(1, round(rng.uniform(*SECONDS) * fps)) / fps
    return settle_down(posture, times, float(rng.uniform(0, 2 * np.pi)), 0.3)


def _check(stage: Stage, takes: list[Take]) -> None:
    for take in takes:
        found = faults(stage.person, take.posture, take.label, stage.pieces, take.piece)
        if found:
            raise RefusedTaskError(found[0])
