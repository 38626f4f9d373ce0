"""Known rooms with a step, on which somebody stands, or with a platform under a seat.

Both are pieces of the room like others. Who comes down from a step sinks evenly over some paces,
who walks onto a platform rises at its edge, without the bend of a knee: what a step tells is where
soles rest, not how they got there.
"""

import dataclasses
from itertools import compress

import numpy as np

from mover.furniture.library import make_piece
from mover.furniture.pieces import block, draw, finish, pair
from mover_bench.rooms.compose import Plan, fits, in_view, overlap
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import (
    Acted,
    Actor,
    KnownRoom,
    NoRoomError,
    RefusedError,
    build,
    one_thread,
)
from mover_bench.rooms.motion import Performance, Stage, Stop, Task, perform
from mover_bench.rooms.moved import candidates, first_draft
from mover_bench.rooms.noise import SEATS_FOR_ONE
from mover_bench.rooms.placed import NoWayError, Placed, corners, on_floor, way
from mover_bench.rooms.poses import chain, make_person, moved
from mover_bench.rooms.room import draw_person, draw_start, draw_tasks, free_place, make_room
from mover_bench.rooms.seating import settle_down, standing
from mover_bench.rooms.turns import heading_of, smooth

LABEL = "step"
SECONDS = (4.0, 6.0)  # [s] of standing on it
WAY = (0.9, 2.5)  # [m] to where one walks from there
DOWN = 0.3  # [m] beyond the step's farthest corner, where both feet are on the floor
FREE = 0.45  # [m] around it
TRIES = 60
HIGH = (0.15, 0.30)  # [m] of a platform
BESIDE, BEHIND, BEFORE = (0.25, 0.45), (0.05, 0.2), (0.75, 0.95)  # [m] of it around its seat
EDGE = 0.12  # [m] from a platform, where people rise: in a frame or two, as feet are up or down
GAP = 0.1  # [m] from a platform to all furniture that is not on it
SHARE = 0.05  # least share of the frames on a platform, most of those in between


@one_thread()
def make_stepped_room(seed: int, config: RoomConfig) -> KnownRoom:
    """The room of a seed with a step on its free floor, on which its video begins.

    Raises:
        NoRoomError: If no step fits, or nobody can use the room then.
    """
    room, refused = make_room(seed, config), list[str]()
    rng = np.random.default_rng([seed, 78])
    for _ in range(TRIES):
        try:
            plan = with_step(room.plan, rng)
            return build(plan, (_climber(plan, config, rng),), config, room.capture.name, ())
        except (RefusedError, NoWayError, ValueError) as error:
            refused.append(str(error))
    raise NoRoomError(f"seed {seed}: no step: {refused[-3:]}")


def with_step(plan: Plan, rng: np.random.Generator) -> Plan:
    """The plan with a step as its last piece, free and in view.

    Raises:
        RefusedError: If it does not fit where it was thrown.
    """
    x, z = free_place(plan, rng)
    piece = make_piece("step", rng)
    step = Placed("step_0", piece, (float(x), float(z)), float(rng.uniform(-np.pi, np.pi)))
    if not fits(step, list(plan.pieces), FREE, plan.walls) or in_view(step, plan.view) < 0.95:
        raise RefusedError("the step stands in the way")
    return dataclasses.replace(plan, pieces=(*plan.pieces, step))


def _climber(plan: Plan, config: RoomConfig, rng: np.random.Generator) -> Acted:
    """Somebody who stands on the last piece, comes down and does random things."""
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    stage = Stage(make_person(draw_person(rng)), plan.pieces, bounds, config.fps)
    step, goal = plan.pieces[-1], free_place(plan, rng)
    place = _top(step)
    if not WAY[0] < np.linalg.norm(goal - place) < WAY[1]:
        raise RefusedError("nowhere to come down to")
    heading = float(heading_of(goal - place))
    top, there = Stop(place, heading, place), Stop(goal, heading, goal)
    still = standing(stage.person, place, heading)
    times = np.arange(1, round(rng.uniform(*SECONDS) * config.fps)) / config.fps
    stands = settle_down(still, times, float(rng.uniform(0, 2 * np.pi)), 0.3)
    count = len(times)
    bare = dataclasses.replace(stage, pieces=plan.pieces[:-1])
    way(top.place, goal, bare.pieces, bounds)  # `perform` would leave out a walk that is none
    walk = perform(bare, (Task("walk", goal=(float(goal[0]), float(goal[1]))),), top, rng)
    rest = perform(stage, draw_tasks(plan, rng, config.stay, config.acts), there, rng)
    whole = Performance(
        chain([stands, walk.posture, rest.posture]),
        ((LABEL,) * count + walk.labels + rest.labels),
        ((len(plan.pieces) - 1,) * count + walk.touched + rest.touched),
        rest.refused,
    )
    acted = Actor(stage, whole).acted
    lift = _lift(step, acted.pelvis[: count + len(walk.labels)], count)
    pelvis = acted.pelvis.copy()
    pelvis[: len(lift), 1] += lift
    return dataclasses.replace(acted, pelvis=pelvis)


def _top(step: Placed) -> np.ndarray:
    """The middle of its highest tread (x, z) [m]."""
    verts = step.furniture.mesh.verts.double().numpy()
    tread = verts[verts[:, 1] > step.furniture.top_height - 1e-3][:, [0, 2]]
    middle = (tread.min(0) + tread.max(0)) / 2
    return on_floor(step, float(middle[0]), float(middle[1]))


def _lift(step: Placed, pelvis: np.ndarray, count: int) -> np.ndarray:
    """How far each frame is above the floor, for so many that stand on the step [m]."""
    flat = pelvis[:, [0, 2]] - step.place
    edge = np.linalg.norm(corners(step) - step.place, axis=1).max()
    away = np.linalg.norm(flat, axis=1)
    share = smooth(np.clip((away - edge / 2) / (edge / 2 + DOWN), 0, 1))
    share[:count] = 0
    return step.furniture.top_height * (1 - np.maximum.accumulate(share))


@one_thread()
def make_platform_room(seed: int, config: RoomConfig) -> KnownRoom:
    """The room of a seed with a platform under the seat for one that is used most.

    What is given has everything on the ground: no tool tells what furniture stands on.

    Raises:
        NoRoomError: If no seat of the room has space for a platform.
    """
    rng = np.random.default_rng([seed, 79])

    def draft(plan: Plan, index: int) -> KnownRoom:
        return _on_platform(plan, index, config, rng)

    return first_draft(
        seed, config, lambda room: candidates(room, SEATS_FOR_ONE), draft, TRIES // 4, "no platform"
    )


def _on_platform(plan: Plan, index: int, config: RoomConfig, rng: np.random.Generator) -> KnownRoom:
    """One draft of the room: acted on a flat floor, then lifted where the platform is.

    What stands in the way of the platform is not in the room.
    """
    platform = _under(plan.pieces[index], rng)
    if not fits(platform, [], GAP, plan.walls) or in_view(platform, plan.view) < 0.7:
        raise RefusedError("the platform has no space")
    keep = [k == index or not overlap(platform, p, GAP) for k, p in enumerate(plan.pieces)]
    index = sum(keep[:index])
    plan = dataclasses.replace(plan, pieces=tuple(compress(plan.pieces, keep)))
    if len(plan.pieces) < config.least_pieces:
        raise RefusedError("too much stands in the way of the platform")
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    stage = Stage(make_person(draw_person(rng)), plan.pieces, bounds, config.fps)
    tasks = (*draw_tasks(plan, rng, config.stay, config.acts), Task("sit", index))
    act = perform(stage, tasks, draw_start(plan, rng), rng)
    lift = _rise(platform, act.posture.pelvis)
    elsewhere = np.array([k not in (-1, index) for k in act.touched])
    top = lift.max()
    on, between = (lift == top).mean(), ((lift > 0) & (lift < top)).mean()
    if (lift[elsewhere] > 0).any() or top == 0 or on < SHARE or between > SHARE:
        raise RefusedError("people stay at the edge of the platform, or nobody uses it")
    posture = moved(act.posture, lift[:, None] * np.array([0.0, 1.0, 0.0]))
    high = platform.furniture.top_height
    seat = dataclasses.replace(plan.pieces[index], height=high, support=platform.id)
    pieces = tuple(seat if k == index else piece for k, piece in enumerate(plan.pieces))
    whole = dataclasses.replace(plan, pieces=(*pieces, platform))
    actor = Actor(stage, dataclasses.replace(act, posture=posture))
    room = build(whole, (actor,), config, "platform", act.refused)
    flat = tuple(dataclasses.replace(p, support="ground") for p in room.truth.objects)
    given = dataclasses.replace(room.capture.scene, objects=flat)
    return dataclasses.replace(room, capture=dataclasses.replace(room.capture, scene=given))


def _under(seat: Placed, rng: np.random.Generator) -> Placed:
    """A platform under a seat, with space to stand before it."""
    width, _, depth = seat.furniture.size
    before, behind = draw(rng, *BEFORE), draw(rng, *BEHIND)
    x, z = pair(width / 2 + draw(rng, *BESIDE)), pair((depth + before + behind) / 2)
    top = draw(rng, *HIGH)
    shape = finish("step", 0, [block(x, (0, top), z)], top=top)
    middle = on_floor(seat, 0.0, (before - behind) / 2)
    return Placed("platform_0", shape, (float(middle[0]), float(middle[1])), seat.heading)


def _rise(platform: Placed, pelvis: np.ndarray) -> np.ndarray:
    """How far each frame is above the floor [m]."""
    width, high, depth = platform.furniture.size
    flat, (left, front) = pelvis[:, [0, 2]] - platform.place, platform.axes
    beside = np.abs(np.stack([flat @ left, flat @ front])) - np.array([[width], [depth]]) / 2
    away = np.linalg.norm(np.maximum(beside, 0), axis=0)
    return high * (1 - smooth(np.clip(away / EDGE, 0, 1)))
