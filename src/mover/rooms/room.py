"""Known rooms: drawn from a seed, or composed by hand for the demo."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..furniture import make_piece
from ..types import Mesh
from .compose import Plan, draw_plan, make_view
from .known import Actor, KnownRoom, RefusedError, build
from .motion import Performance, Stage, Stop, Task, perform
from .person import make_person
from .placed import Placed
from .poses import jointed, rows
from .render import draw_bodies, see
from .room_config import RoomConfig
from .scripts import draw_person, draw_start, draw_tasks
from .threads import one_thread
from .truth import faults

CLEAR = 0.25  # [m], between the joints of two people
MOST_WAIT = 24.0  # [s], before somebody begins


@one_thread()
def make_room(seed: int, config: RoomConfig | None = None) -> KnownRoom:
    """A room in which everything is known; the same for the same seed and configuration.

    Raises:
        ValueError: If 60 drafts in a row had to be refused.
    """
    config = config or RoomConfig()
    refused: list[str] = []
    for draft in range(60):
        rng = np.random.default_rng([seed, draft])
        try:
            size = (config.width, config.height)
            plan = draw_plan(rng, size, config.pieces, config.least_pixels, config.plan)
            room = build(
                plan, _cast(plan, config, rng, refused), config, f"room_{seed}", tuple(refused)
            )
        except RefusedError as error:
            refused.append(f"draft {draft}: {error}")
        else:
            return room
    raise ValueError(f"seed {seed}: 60 drafts were refused: {refused[-3:]}")


def _cast(
    plan: Plan, config: RoomConfig, rng: np.random.Generator, refused: list[str]
) -> tuple[Actor, ...]:
    """Everybody's performance."""
    if len(plan.pieces) < config.least_pieces:
        raise RefusedError(f"only {len(plan.pieces)} pieces fit")
    actors: list[Actor] = []
    for _ in range(6 * config.people):
        if len(actors) == config.people:
            break
        actor = _actor(plan, config, rng)
        wait = patience(actor, actors)
        if wait is not None:
            refused += actor.performance.refused
            whole = late(actor.performance, wait)
            acted = cut(whole, config.most_frames) if config.most_frames else whole
            actors.append(dataclasses.replace(actor, performance=acted))
    if len(actors) < config.people:
        raise RefusedError("people run into each other")
    return tuple(actors)


def _actor(plan: Plan, config: RoomConfig, rng: np.random.Generator) -> Actor:
    """Somebody of a random shape who does random things."""
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    person, apart = make_person(draw_person(rng)), config.acts.apart
    stage = Stage(person, plan.pieces, bounds, config.fps, apart)
    try:
        tasks, start = draw_tasks(plan, rng, config.stay, config.acts), draw_start(plan, rng)
    except ValueError as error:
        raise RefusedError(str(error)) from error
    actor = Actor(stage, perform(stage, tasks, start, rng, config.most_frames))
    if apart > 0:  # also between the tasks
        near = faults(person, actor.performance.posture, "walk", plan.pieces, -1, apart)
        if near:
            raise RefusedError(near[0])
    return actor


def patience(newcomer: Actor, others: list[Actor]) -> int | None:
    """Fewest frames to stand still first so that joints of two people keep `CLEAR`; None: never."""
    if not others:
        return 0
    own = jointed(newcomer.stage.person, newcomer.performance.posture)
    theirs = [jointed(o.stage.person, o.performance.posture) for o in others]
    for wait in range(0, int(MOST_WAIT * newcomer.stage.fps) + 1, 2):
        mine = np.concatenate([np.repeat(own[:1], wait, axis=0), own])
        if all(_clear(mine, joints) for joints in theirs):
            return wait
    return None


def _clear(a: np.ndarray, b: np.ndarray) -> bool:
    frames = min(len(a), len(b))
    middle = np.linalg.norm(a[:frames, 0] - b[:frames, 0], axis=-1)
    near = np.flatnonzero(middle < 2.0)
    gap = np.linalg.norm(a[near, :, None] - b[near, None], axis=-1)
    return bool(gap.size == 0 or gap.min() > CLEAR)


def cut(performance: Performance, frames: int) -> Performance:
    """The first frames of it."""
    first = slice(0, frames)
    return Performance(
        rows(performance.posture, first),
        performance.labels[first],
        performance.touched[first],
        performance.refused,
    )


def late(performance: Performance, wait: int) -> Performance:
    """The same, after standing still for so many frames."""
    order = np.maximum(np.arange(-wait, len(performance.labels)), 0)
    return Performance(
        rows(performance.posture, order),
        ("stand",) * wait + performance.labels,
        (-1,) * wait + performance.touched,
        performance.refused,
    )


_DEMO: tuple[tuple[str, str, int, int, tuple[float, float, float]], ...] = (
    ("bed_0", "single bed", 0, 3, (-1.75, -5.08, 0.0)),
    ("nightstand_0", "nightstand", 0, 3, (-0.9, -5.92, 0.0)),
    ("shelf_0", "shelf", 2, 3, (-0.05, -5.98, 0.0)),
    ("cabinet_0", "cabinet", 1, 3, (0.95, -5.9, 0.0)),
    ("sofa_0", "sofa", 0, 6, (2.1, -4.72, -1.5708)),
    ("floor_lamp_0", "floor lamp", 0, 3, (1.72, -6.02, 0.0)),
    ("table_0", "table", 0, 3, (-0.98, -3.2, 0.05)),
    ("chair_0", "chair", 1, 3, (0.45, -3.9, 0.35)),
)
"""Id, piece, style, seed of the sizes, and (x, z, heading) of the demo's furniture."""


@one_thread()
def demo_room() -> KnownRoom:
    """A bed-sitting room whose tenant walks, sits, leans back, lies and stands at a table."""
    pieces = tuple(
        Placed(name, make_piece(kind, np.random.default_rng(sizes), style), spot[:2], spot[2])
        for name, kind, style, sizes, spot in _DEMO
    )
    view = make_view((960, 540), (1.62, float(np.radians(-12.5)), float(np.radians(1.1)), 1.15))
    plan = Plan(pieces, view, (-2.75, -6.25), (2.75, -1.9))
    tasks = (
        Task("walk", goal=(1.1, -4.9)),
        Task("sit", 7, seconds=5.0),
        Task("lean", 4, seconds=5.0, along=0.3),
        Task("table", 6, seconds=4.0, side=2),
        Task("lie", 0, seconds=6.0, side=1, roll=True),
        Task("walk", goal=(0.9, -3.0)),
    )
    stage = Stage(make_person([0.0] * 10), pieces, np.array([[-2.5, -6.0], [2.5, -2.1]]), 5.0)
    start = Stop(np.array([0.9, -2.95]), 3.0, np.array([0.9, -2.95]))
    performance = perform(stage, tasks, start, np.random.default_rng(5))
    actors = (Actor(stage, performance),)
    return build(plan, actors, RoomConfig(), "demo", performance.refused)


@one_thread()
def draw_frame(room: KnownRoom, frame: int) -> Float[Tensor, "h w 3"]:
    """A picture of the room with everybody in it, in [0, 1]."""
    rows = torch.nonzero(room.bodies.frame == frame)[:, 0].tolist()
    meshes = [Mesh(room.bodies.verts[k], room.bodies.faces) for k in rows]
    return draw_bodies(room.plan, see(room.plan), meshes)
