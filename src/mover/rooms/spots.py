"""Where a piece of furniture may stand: along a wall, around a table, in the middle of a room."""

from collections.abc import Callable
from typing import Literal

import numpy as np

from .placed import Placed
from .turns import facing, heading_of, left_of

Rule = Literal["wall", "corner", "middle", "facing", "before", "around", "beside"]
Pose = tuple[float, float, float]
Size = tuple[float, float, float]
Others = list[Placed]


def _wall(rng: np.random.Generator, size: Size, walls: np.ndarray, _: Others) -> Pose:
    side = int(rng.integers(3))
    off = size[2] / 2 + float(rng.uniform(0.02, 0.06))
    half = size[0] / 2 + 0.02
    if side == 0:
        return float(rng.uniform(walls[0, 0] + half, walls[1, 0] - half)), walls[0, 1] + off, 0.0
    z = float(rng.uniform(walls[0, 1] + half, max(walls[0, 1] + half + 0.1, -2.6 - half)))
    turn = np.pi / 2 if side == 1 else -np.pi / 2
    return (walls[0, 0] + off if side == 1 else walls[1, 0] - off), z, turn


def _corner(rng: np.random.Generator, size: Size, walls: np.ndarray, _: Others) -> Pose:
    off = max(size[0], size[2]) / 2 + float(rng.uniform(0.03, 0.5))
    x = walls[0, 0] + off if rng.integers(2) else walls[1, 0] - off
    return float(x), float(walls[0, 1] + off), float(rng.uniform(-np.pi, np.pi))


def _middle(rng: np.random.Generator, _: Size, walls: np.ndarray, __: Others) -> Pose:
    x = float(rng.uniform(-1.4, 1.4))
    z = float(rng.uniform(walls[0, 1] + 1.6, -3.1))
    return x, z, float(rng.choice([0.0, np.pi / 2]) + np.radians(rng.uniform(-8, 8)))


def _facing(rng: np.random.Generator, _: Size, walls: np.ndarray, __: Others) -> Pose:
    x = float(rng.uniform(walls[0, 0] + 0.6, walls[1, 0] - 0.6))
    z = float(rng.uniform(walls[0, 1] + 0.6, -2.7))
    centre = np.array([0.0, (walls[0, 1] - 2.8) / 2])
    heading = float(heading_of(centre - np.array([x, z])) + np.radians(rng.uniform(-50, 50)))
    return x, z, heading


def _before(rng: np.random.Generator, size: Size, _: np.ndarray, others: Others) -> Pose | None:
    sofas = [p for p in others if p.furniture.category == "sofa"]
    if not sofas:
        return None
    front = sofas[0].furniture.size[2] / 2 + size[2] / 2 + float(rng.uniform(0.8, 1.0))
    place = sofas[0].place + front * facing(np.array(sofas[0].heading))
    return float(place[0]), float(place[1]), sofas[0].heading


def _around(rng: np.random.Generator, size: Size, _: np.ndarray, others: Others) -> Pose | None:
    tables = [p for p in others if p.furniture.category == "table"]
    if not tables:
        return None
    side = int(rng.integers(4))
    w, d = tables[0].furniture.size[0], tables[0].furniture.size[2]
    away = (d if side % 2 == 0 else w) / 2 + size[2] / 2 + float(rng.uniform(0.06, 0.45))
    out = tables[0].heading + side * np.pi / 2
    place = tables[0].place + away * facing(np.array(out))
    turn = float(rng.choice([np.pi, np.pi / 2, -np.pi / 2, 0.0])) + np.radians(rng.uniform(-20, 20))
    return float(place[0]), float(place[1]), float(out + turn)


def _beside(rng: np.random.Generator, size: Size, _: np.ndarray, others: Others) -> Pose | None:
    beds = [p for p in others if p.furniture.category == "bed"]
    if not beds:
        return None
    bed = beds[0]
    side = 1 if rng.integers(2) else -1
    across = side * (bed.furniture.size[0] / 2 + size[0] / 2 + float(rng.uniform(0.06, 0.12)))
    along = -bed.furniture.size[2] / 2 + size[2] / 2
    place = (
        bed.place + across * left_of(np.array(bed.heading)) + along * facing(np.array(bed.heading))
    )
    return float(place[0]), float(place[1]), bed.heading


RULES: dict[Rule, Callable[[np.random.Generator, Size, np.ndarray, Others], Pose | None]] = {
    "wall": _wall, "corner": _corner, "middle": _middle, "facing": _facing, "before": _before,
    "around": _around, "beside": _beside,
}  # fmt: skip
"""Draws (x [m], z [m], heading [rad]) of a piece of a size among others; None: nowhere."""
