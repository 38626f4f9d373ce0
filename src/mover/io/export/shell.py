"""Walls that nobody saw: guessed from the layout that a tool gave, or from furniture along them.

Rooms are taken for rectangles. Where the scene has a layout, its four sides are walls. Else the
axes are those of most furniture, and a side gets a wall where a piece that usually stands along
walls turns its back to it, in line with the outermost; sides without such a piece stay open. No
wall may cut a piece, a person or the camera: it lies outside of all of them. A guess is marked as
one wherever it is written.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float
from msgspec import Struct
from torch import Tensor

from mover.core.records import record
from mover.core.types import Bodies, Scene, SceneObject
from mover.furniture.library import WALL_PIECES, canonical
from mover.geometry.boxes import box_of, corners
from mover.geometry.rotations import wrap
from mover.io.files.fields import At, plain
from mover.io.files.schema import Number, checked

Walls = Literal["none", "guess"]
WALLS = "guessed_walls"
"""Field of stable.json: the walls that pieces were nudged along."""
GUESSED = "guessed_wall"  # what the names of walls begin with
TURNED = math.radians(12)  # [rad], of a back that faces a wall, at most
SAME = math.radians(4)  # [rad], usual difference of pieces along walls of one room
LINE = 0.25  # [m], of a back from the outermost thing of its side, at most
HEIGHT, THICKNESS = 2.5, 0.1  # [m]
CLEARANCE = 0.02  # [m], from furniture to the wall


@record
class Wall:
    """A wall of a room, from the floor up."""

    start: Float[Tensor, "2"]
    """(x, z) of one end of its inner face [m]."""
    end: Float[Tensor, "2"]
    out: Float[Tensor, "2"]
    """Unit normal, out of the room."""
    pieces: tuple[str, ...]
    """Ids of what stands along it; none where the layout tells it."""

    @property
    def source(self) -> str:
        """What the guess rests on."""
        return ", ".join(self.pieces) or "the layout that was given"


def guess_walls(scene: Scene, bodies: Bodies | None) -> tuple[Wall, ...]:
    """The walls of a scene, as far as a layout or its furniture tells them.

    Args:
        scene: A result; the camera is at its origin.
        bodies: Its people, in the world: nobody walks through walls.
    """
    layout = None if scene.layout is None else scene.layout.double()
    if not scene.objects and layout is None:
        return ()
    yaw = _main_yaw(scene.objects) if layout is None else _yaw_of(layout)
    c, s = math.cos(yaw), math.sin(yaw)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)  # from the world to the room's axes
    foot = [corners(box_of(p)).double()[:, ::2] @ turn.mT for p in scene.objects]
    inside = [*foot, torch.zeros(1, 2, dtype=torch.float64)]
    if bodies is not None:
        inside.append(bodies.verts[..., ::2].double().reshape(-1, 2) @ turn.mT)
    low = torch.stack([points.amin(0) for points in inside]).amin(0) - CLEARANCE
    high = torch.stack([points.amax(0) for points in inside]).amax(0) + CLEARANCE
    if layout is not None:
        flat = layout @ turn.mT
        low, high = torch.minimum(low, flat.amin(0)), torch.maximum(high, flat.amax(0))
    found: list[Wall] = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        edge = float((low if sign < 0 else high)[axis])
        along = _along(scene.objects, foot, (axis, sign, edge), yaw)
        if along or layout is not None:
            ends = torch.stack([low, high])
            ends[:, axis] = edge
            out = torch.zeros(2, dtype=torch.float64)
            out[axis] = sign
            start, end = (ends @ turn).unbind(0)
            found.append(Wall(start, end, out @ turn, along if layout is None else ()))
    return tuple(found)


def _yaw_of(layout: Float[Tensor, "4 2"]) -> float:
    """The turn of a rectangle's first side."""
    x, z = (layout[1] - layout[0]).tolist()
    return math.atan2(-z, x)


def _main_yaw(objects: tuple[SceneObject, ...]) -> float:
    """The turn that most furniture shares, up to a quarter; what stands askew does not count."""
    yaw = torch.stack([box_of(piece).yaw.double() for piece in objects])
    size = torch.stack([box_of(piece).size.double() for piece in objects])
    usual = torch.tensor([canonical(p.category) in WALL_PIECES for p in objects])
    weight = size[:, [0, 2]].amax(1) * torch.where(usual, 2.0, 1.0)
    apart = wrap(4 * (yaw[:, None] - yaw)) / 4
    votes = (weight * (-(apart / SAME).square()).exp()).sum(1)
    best = int(votes.argmax())
    near = weight * (apart[best].abs() < 2 * SAME)
    return float(yaw[best] - (near * apart[best]).sum() / near.sum())


def _along(
    objects: tuple[SceneObject, ...],
    foot: list[Float[Tensor, "8 2"]],
    side: tuple[int, int, float],
    yaw: float,
) -> tuple[str, ...]:
    """Ids of the pieces that turn their backs to a side and stand at its edge."""
    axis, sign, edge = side
    found: list[str] = []
    for piece, points in zip(objects, foot, strict=True):
        if canonical(piece.category) not in WALL_PIECES or piece.support != "ground":
            continue
        turn = float(piece.yaw) - yaw
        back = torch.tensor([-math.sin(turn), -math.cos(turn)])
        beside = abs(edge - float(points[:, axis].max() if sign > 0 else points[:, axis].min()))
        if float(sign * back[axis]) > math.cos(TURNED) and beside < LINE:
            found.append(piece.id)
    return tuple(found)


def slab(wall: Wall) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Middle (x, z), length and thickness of a wall [m], and its turn about +y [rad]."""
    way = wall.end - wall.start
    middle = (wall.start + wall.end) / 2 + wall.out * THICKNESS / 2
    x, z = middle.tolist()
    return (x, z), (float(way.norm()), THICKNESS), math.atan2(-float(way[1]), float(way[0]))


def wall_notes(walls: tuple[Wall, ...]) -> tuple[str, ...]:
    """What a guess rests on."""
    if not walls:
        return ("no walls: nothing stands along any",)
    return tuple(f"a wall is guessed from {wall.source}" for wall in walls)


class WallFields(Struct, frozen=True):
    """A wall in a file."""

    start: tuple[Number, Number]
    end: tuple[Number, Number]
    out: tuple[Number, Number]
    pieces: list[str]


def wall_rows(walls: Sequence[Wall]) -> list[dict[str, Any]]:
    """Walls as a file has them."""
    return [
        {"start": plain(w.start), "end": plain(w.end), "out": plain(w.out), "pieces": [*w.pieces]}
        for w in walls
    ]


def walls_in(at: At) -> tuple[Wall, ...]:
    """Walls of a file."""
    rows = checked(at, list[WallFields])

    def spot(place: tuple[float, float]) -> Float[Tensor, "2"]:
        return torch.tensor(place, dtype=torch.float64)

    return tuple(Wall(spot(r.start), spot(r.end), spot(r.out), tuple(r.pieces)) for r in rows)
