"""What people are asked to do in a room."""

import numpy as np

from ..furniture.library import canonical
from .compose import Plan
from .motion import DOOR, Stop, Task
from .paths import ROOMY
from .placed import Placed, free_of
from .reaching import table_stand
from .room_config import ActConfig
from .turns import facing

SITS = frozenset({"chair", "armchair", "office chair", "sofa", "stool", "bench"})
STANDS = frozenset({"table", "desk", "cabinet"})
PLACES = 60  # to choose walks from
GONE = 4  # so many last goals the next one keeps away from


def draw_person(rng: np.random.Generator) -> list[float]:
    """Shape coefficients of an adult."""
    return [float(b) for b in np.clip(rng.normal(0, 0.7, 4), -1.4, 1.4)] + [0.0] * 6


def free_place(plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """A place to stand with room around it, in view of the camera (x, z) [m].

    Raises:
        ValueError: If there is none.
    """
    low, high = plan.walls[0] + 0.45, np.array([plan.walls[1, 0] - 0.45, -2.9])
    for _ in range(200):
        place = rng.uniform(low, high)
        if abs(place[0]) < 0.5 * -place[1] and free_of(place, plan.pieces, ROOMY):
            return place
    raise ValueError("the room has no free floor")


def draw_start(plan: Plan, rng: np.random.Generator) -> Stop:
    """Where a person is when the video begins."""
    place = free_place(plan, rng)
    return Stop(place, float(rng.uniform(-np.pi, np.pi)), place)


def draw_tasks(
    plan: Plan, rng: np.random.Generator, length: float, acts: ActConfig
) -> tuple[Task, ...]:
    """Sit, lean, lie and stand at tables in random order; walk before and after.

    Args:
        plan: The room.
        rng: Source of randomness.
        length: Factor on all times to stay.
        acts: How much.
    """
    if acts.apart > 0:
        return draw_walks(plan, rng, acts.walks)
    tasks: list[Task] = []
    for _ in range(acts.rounds):
        uses = _uses(plan, rng, length)
        tasks += [uses[k] for k in rng.permutation(len(uses))]
    walks = [Task("walk", goal=_pair(free_place(plan, rng))) for _ in range(acts.walks)]
    return (*walks[:1], *tasks[: acts.tasks], *walks[1:])


def draw_walks(plan: Plan, rng: np.random.Generator, count: int) -> tuple[Task, ...]:
    """Walks to free places far from one another, every other one behind furniture if there is one.

    Args:
        plan: The room.
        rng: Source of randomness.
        count: How many.
    """
    places = np.array([free_place(plan, rng) for _ in range(PLACES)])
    behind = places[[_is_behind(place, plan) for place in places]]
    goals = places[:1]
    for k in range(count):
        pool = places if k % 2 or not len(behind) else behind
        apart = np.linalg.norm(pool[:, None] - goals[-GONE:], axis=-1).min(1)
        goals = np.concatenate([goals, pool[[int(apart.argmax())]]])
    return tuple(Task("walk", goal=_pair(goal)) for goal in goals[1:])


def _is_behind(place: np.ndarray, plan: Plan) -> bool:
    """Whether furniture stands between the camera and a place."""
    line = np.linspace(0, 1, 60)[:, None] * place
    return not bool(free_of(line, plan.pieces, 0.0).all())


def _uses(plan: Plan, rng: np.random.Generator, length: float) -> list[Task]:
    """What can be done with each piece, once."""
    tasks: list[Task] = []
    for index, piece in enumerate(plan.pieces):
        name = canonical(piece.furniture.category)
        stay = length * float(rng.uniform(4.5, 6.5))
        if name in SITS:
            lean = piece.furniture.back_height > 0 and rng.uniform() < 0.6
            along = _along(piece, rng)
            tasks.append(Task("lean" if lean else "sit", index, seconds=stay, along=along))
        if name == "bed" or (
            name == "sofa"
            and piece.furniture.seat_right - piece.furniture.seat_left > 1.3
            and rng.uniform() < 0.5
        ):
            side, roll = (1 if rng.integers(2) else -1), name == "bed"
            tasks.append(Task("lie", index, seconds=stay, side=side, roll=roll))
        if name in STANDS and 0.65 < piece.furniture.top_height < 1.0:
            side = _open_side(plan, index, rng)
            tasks.append(Task("table", index, seconds=0.7 * stay, side=side))
    return tasks


def _pair(place: np.ndarray) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _along(piece: Placed, rng: np.random.Generator) -> float:
    room = (piece.furniture.seat_right - piece.furniture.seat_left) / 2 - 0.3
    return float(rng.uniform(-room, room)) if room > 0 else 0.0


def _open_side(plan: Plan, index: int, rng: np.random.Generator) -> int:
    sides = [0, 1, 2, 3] if plan.pieces[index].furniture.category == "table" else [0]
    others = tuple(p for k, p in enumerate(plan.pieces) if k != index)
    good = []
    for side in sides:
        place, heading = table_stand(plan.pieces, index, side, 0.0)
        door = place - DOOR * facing(np.array(heading))
        inside = (door > plan.walls[0] + 0.3).all() and (door < plan.walls[1] - 0.3).all()
        if inside and free_of(door, others, 0.3) and free_of(place, others, 0.25):
            good.append(side)
    return int(rng.choice(good)) if good else sides[0]
