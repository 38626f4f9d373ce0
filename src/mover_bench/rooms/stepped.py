"""Known rooms with a step: somebody stands on it, comes down, and uses the room.

The step is a piece of the room like others. Who comes down sinks evenly while the first paces are
walked, without the bend of a knee: what a step tells is where soles rest, not how they got there.
"""

import dataclasses

import numpy as np

from mover.furniture.library import make_piece
from mover_bench.rooms.compose import Plan, fits, in_view
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import Acted, Actor, KnownRoom, RefusedError, build, one_thread
from mover_bench.rooms.motion import Performance, Stage, Stop, Task, perform
from mover_bench.rooms.placed import NoWayError, Placed, corners, on_floor, way
from mover_bench.rooms.poses import chain, make_person
from mover_bench.rooms.room import draw_person, draw_tasks, free_place, make_room
from mover_bench.rooms.seating import settle_down, standing
from mover_bench.rooms.turns import heading_of, smooth

LABEL = "step"
SECONDS = (4.0, 6.0)  # [s] of standing on it
WAY = (0.9, 2.5)  # [m] to where one walks from there
DOWN = 0.3  # [m] beyond the step's farthest corner, where both feet are on the floor
FREE = 0.45  # [m] around it
TRIES = 60


@one_thread()
def make_stepped_room(seed: int, config: RoomConfig) -> KnownRoom:
    """The room of a seed with a step on its free floor, on which its video begins.

    Raises:
        ValueError: If no step fits, or nobody can use the room then.
    """
    room, refused = make_room(seed, config), list[str]()
    rng = np.random.default_rng([seed, 78])
    for _ in range(TRIES):
        try:
            plan = with_step(room.plan, rng)
            return build(plan, (_climber(plan, config, rng),), config, room.capture.name, ())
        except (RefusedError, NoWayError, ValueError) as error:
            refused.append(str(error))
    raise ValueError(f"seed {seed}: no step: {refused[-3:]}")


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
