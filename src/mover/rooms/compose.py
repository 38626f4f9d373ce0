"""Furnish a room: what stands where, and from where the camera sees it."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from ..furniture import make_piece
from ..geometry.camera import project, tilted, to_camera
from ..records import record
from ..types import Camera
from .placed import Placed, corners, verts_on_floor
from .turns import facing, heading_of, left_of

Rule = Literal["wall", "corner", "middle", "facing", "before", "around", "beside"]
Pose = tuple[float, float, float]


@record
class View:
    """The camera over the floor: it stands at x = z = 0."""

    camera: Camera
    height: float
    """Above the floor [m]."""


@record
class Plan:
    """A furnished room."""

    pieces: tuple[Placed, ...]
    view: View
    low: tuple[float, float]
    """Smallest x and z of the floor [m]."""
    high: tuple[float, float]
    """Largest x and z of the floor [m]."""

    @property
    def walls(self) -> Float[np.ndarray, "2 2"]:
        """Smallest, then largest x and z of the floor [m]."""
        return np.array([self.low, self.high])


KINDS: dict[str, tuple[tuple[str, Rule], ...]] = {
    "living room": (
        ("sofa", "wall"), ("coffee table", "before"), ("table", "middle"), ("chair", "around"),
        ("armchair", "facing"), ("shelf", "wall"), ("cabinet", "wall"), ("floor lamp", "corner"),
        ("stool", "facing"),
    ),
    "bedroom": (
        ("double bed", "wall"), ("nightstand", "beside"), ("wardrobe", "wall"), ("desk", "wall"),
        ("chair", "facing"), ("cabinet", "wall"), ("armchair", "facing"), ("floor lamp", "corner"),
    ),
    "dining room": (
        ("table", "middle"), ("chair", "around"), ("chair", "around"), ("sofa", "wall"),
        ("cabinet", "wall"), ("shelf", "wall"), ("bench", "facing"), ("floor lamp", "corner"),
    ),
    "studio": (
        ("single bed", "wall"), ("desk", "wall"), ("office chair", "facing"),
        ("armchair", "facing"), ("shelf", "wall"), ("nightstand", "beside"), ("cabinet", "wall"),
        ("floor lamp", "corner"),
    ),
}  # fmt: skip
"""What stands in each kind of room, the most important first."""

TRIES = 40
LEAST_VISIBLE = 0.85  # share of the corners of a piece's box inside the image
MARGIN: dict[Rule, float] = {
    "wall": 0.06, "corner": 0.05, "middle": 0.5, "facing": 0.45, "before": 0.1, "around": 0.04,
    "beside": 0.04,
}  # fmt: skip
"""Free floor around a piece, by where it stands [m]."""


def make_view(size: tuple[int, int], numbers: tuple[float, float, float, float]) -> View:
    """A camera of a width and height [px] with (height [m], pitch, roll, field of view [rad])."""
    width, height = size
    above, pitch, roll, fov = numbers
    focal = width / 2 / np.tan(fov / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    turn = tilted(torch.tensor(pitch, dtype=torch.float64), torch.tensor(roll, dtype=torch.float64))
    return View(Camera(K.float(), turn.float(), width, height), above)


def draw_view(rng: np.random.Generator, size: tuple[int, int]) -> View:
    """A camera as somebody would put it up: 1.3-1.9 m high, looking 8-16 degrees down."""
    height = float(rng.uniform(1.35, 1.9))
    pitch = -np.radians(rng.uniform(8, 14) + 4 * (height - 1.35))
    roll = np.radians(rng.uniform(-2, 2))
    return make_view(
        size, (height, float(pitch), float(roll), float(np.radians(rng.uniform(61, 69))))
    )


def draw_plan(rng: np.random.Generator, size: tuple[int, int], most: int) -> Plan:
    """A room of a random kind with at most so many pieces."""
    view = draw_view(rng, size)
    wide, deep = float(rng.uniform(4.6, 5.4)), float(rng.uniform(5.6, 6.4))
    low, high = (-wide / 2, -deep), (wide / 2, -1.9)
    walls = np.array([low, high])
    kind = sorted(KINDS)[int(rng.integers(len(KINDS)))]
    pieces: list[Placed] = []
    for name, rule in KINDS[kind][:most]:
        furniture = make_piece(name, rng)
        count = sum(p.furniture.category == furniture.category for p in pieces)
        label = f"{furniture.category.replace(' ', '_')}_{count}"
        for _ in range(TRIES):
            spot = _RULES[rule](rng, furniture.size, walls, pieces)
            if spot is None:
                break
            piece = Placed(label, furniture, (spot[0], spot[1]), spot[2])
            if _fits(piece, pieces, MARGIN[rule], walls) and in_view(piece, view) >= LEAST_VISIBLE:
                pieces.append(piece)
                break
    return Plan(tuple(pieces), view, low, high)


def in_view(piece: Placed, view: View) -> float:
    """Share of the vertices that the image holds."""
    verts = torch.from_numpy(verts_on_floor(piece)).float()
    cam = to_camera(verts - torch.tensor([0, view.height, 0]), view.camera.R_cam_world)
    pixel = project(cam, view.camera.K)
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = ((pixel > 0) & (pixel < size)).all(-1) & (cam[:, 2] > 0.3)
    return float(inside.double().mean())


def _fits(piece: Placed, others: list[Placed], margin: float, walls: np.ndarray) -> bool:
    own = corners(piece)
    if (own < walls[0] + 0.01).any() or (own > walls[1] - 0.01).any():
        return False
    return not any(overlap(piece, other, margin) for other in others)


def overlap(a: Placed, b: Placed, margin: float) -> bool:
    """Whether footprints come nearer than `margin` (along some edge's normal) [m]."""
    first, second = corners(a, margin / 2), corners(b, margin / 2)
    for heading in (a.heading, b.heading):
        for axis in (facing(np.array(heading)), left_of(np.array(heading))):
            p, q = first @ axis, second @ axis
            if p.max() < q.min() or q.max() < p.min():
                return False
    return True


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
    z = float(rng.uniform(walls[0, 1] + 0.6, -3.0))
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


_RULES: dict[Rule, Callable[[np.random.Generator, Size, np.ndarray, Others], Pose | None]] = {
    "wall": _wall, "corner": _corner, "middle": _middle, "facing": _facing, "before": _before,
    "around": _around, "beside": _beside,
}  # fmt: skip
