"""A furnished room before a camera.

Pieces stand along a wall, around a table, in the middle of a room; how much of each others hide is
counted in a small picture without people.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Camera
from mover.furniture.library import make_piece
from mover.geometry.camera import project, tilted, to_camera
from mover.geometry.raster import first_hit
from mover_bench.rooms.config import PlanConfig, RoomConfig, Rule
from mover_bench.rooms.placed import Placed, corners, on_floor, verts_on_floor
from mover_bench.rooms.poses import facing, heading_of

Pose = tuple[float, float, float]
Size = tuple[float, float, float]
Random = np.random.Generator


def _wall(rng: Random, size: Size, walls: np.ndarray) -> Pose:
    side = int(rng.integers(3))
    off = size[2] / 2 + float(rng.uniform(0.02, 0.06))
    half = size[0] / 2 + 0.02
    if side == 0:
        return float(rng.uniform(walls[0, 0] + half, walls[1, 0] - half)), walls[0, 1] + off, 0.0
    z = float(rng.uniform(walls[0, 1] + half, max(walls[0, 1] + half + 0.1, -2.6 - half)))
    turn = np.pi / 2 if side == 1 else -np.pi / 2
    return (walls[0, 0] + off if side == 1 else walls[1, 0] - off), z, turn


def _corner(rng: Random, size: Size, walls: np.ndarray) -> Pose:
    off = max(size[0], size[2]) / 2 + float(rng.uniform(0.03, 0.5))
    x = walls[0, 0] + off if rng.integers(2) else walls[1, 0] - off
    return float(x), float(walls[0, 1] + off), float(rng.uniform(-np.pi, np.pi))


def _middle(rng: Random, _: Size, walls: np.ndarray) -> Pose:
    x = float(rng.uniform(-1.4, 1.4))
    z = float(rng.uniform(walls[0, 1] + 1.6, -3.1))
    return x, z, float(rng.choice([0.0, np.pi / 2]) + np.radians(rng.uniform(-8, 8)))


def _facing(rng: Random, _: Size, walls: np.ndarray) -> Pose:
    x = float(rng.uniform(walls[0, 0] + 0.6, walls[1, 0] - 0.6))
    z = float(rng.uniform(walls[0, 1] + 0.6, -2.7))
    centre = np.array([0.0, (walls[0, 1] - 2.8) / 2])
    heading = float(heading_of(centre - np.array([x, z])) + np.radians(rng.uniform(-50, 50)))
    return x, z, heading


def _before(rng: Random, size: Size, sofa: Placed) -> Pose:
    away = sofa.furniture.size[2] / 2 + size[2] / 2 + float(rng.uniform(0.8, 1.0))
    x, z = sofa.place + away * sofa.axes[1]
    return float(x), float(z), sofa.heading


def _around(rng: Random, size: Size, table: Placed) -> Pose:
    side = int(rng.integers(4))
    w, d = table.furniture.size[0], table.furniture.size[2]
    away = (d if side % 2 == 0 else w) / 2 + size[2] / 2 + float(rng.uniform(0.06, 0.45))
    out = table.heading + side * np.pi / 2
    x, z = table.place + away * facing(np.array(out))
    turn = float(rng.choice([np.pi, np.pi / 2, -np.pi / 2, 0.0])) + np.radians(rng.uniform(-20, 20))
    return float(x), float(z), float(out + turn)


def _beside(rng: Random, size: Size, bed: Placed) -> Pose:
    side = 1 if rng.integers(2) else -1
    across = side * (bed.furniture.size[0] / 2 + size[0] / 2 + float(rng.uniform(0.06, 0.12)))
    x, z = on_floor(bed, across, -bed.furniture.size[2] / 2 + size[2] / 2)
    return float(x), float(z), bed.heading


IN_ROOM: dict[Rule, Callable[[Random, Size, np.ndarray], Pose]] = {
    "wall": _wall, "corner": _corner, "middle": _middle, "facing": _facing,
}  # fmt: skip
"""Draws (x [m], z [m], heading [rad]) of a piece of a size between walls,"""
BY_ANOTHER: dict[Rule, tuple[str, Callable[[Random, Size, Placed], Pose]]] = {
    "before": ("sofa", _before), "around": ("table", _around), "beside": ("bed", _beside),
}  # fmt: skip
"""and by the first piece of a category."""


def _drawn(
    rule: Rule, rng: Random, size: Size, walls: np.ndarray, others: list[Placed]
) -> Pose | None:
    """A pose by a rule; None: there is no piece of the category."""
    if rule in IN_ROOM:
        return IN_ROOM[rule](rng, size, walls)
    category, draw = BY_ANOTHER[rule]
    other = next((p for p in others if p.furniture.category == category), None)
    return None if other is None else draw(rng, size, other)


WIDTH = 240  # [px] of the small picture
HIDDEN = 0.3  # a piece of which more is hidden counts as hidden


@record
class Viewpoint:
    """The camera over the floor: it stands at x = z = 0."""

    camera: Camera
    height: float  #: above the floor [m]

    def seen(self, points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
        """Points in the frame of the floor in camera axes [m]."""
        return to_camera(points - torch.tensor([0, self.height, 0]), self.camera.R_cam_world)


def depth_of(piece: Placed, view: Viewpoint) -> Float[Tensor, "h w"]:
    """Depth of a piece drawn alone by a camera above the floor [m], infinite where it is not."""
    camera = view.camera
    zoom = WIDTH / camera.width
    size = (max(1, round(camera.height * zoom)), WIDTH)
    K = camera.K * torch.tensor([[zoom], [size[0] / camera.height], [1.0]])
    return first_hit(view.seen(verts_on_floor(piece)), piece.furniture.mesh.faces, K, size)[0]


def worth(depths: list[Float[Tensor, "h w"]], least: float, most: float) -> float:
    """How many objects others occlude well, plus a little; -1 where one can hardly be seen.

    `depths` are those of each object drawn alone [m]; each must show `least` pixels of the small
    picture, and others may occlude no more than the share `most` of it.
    """
    alone = torch.stack(depths)
    covered = alone.isfinite()
    seen = (covered & (alone <= alone.amin(0))).sum((1, 2)).numpy()
    hidden = 1 - seen / covered.sum((1, 2)).clamp_min(1).numpy()
    if (hidden > most).any() or (seen < least).any():
        return -1.0
    return float((hidden >= HIDDEN).sum() + 0.1 * hidden.mean())


@record
class Plan:
    """A furnished room."""

    pieces: tuple[Placed, ...]
    view: Viewpoint
    low: tuple[float, float]  #: smallest x and z of the floor [m]
    high: tuple[float, float]  #: largest x and z of the floor [m]

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

ROUNDS = 5  # rooms to choose from
TRIES = 40
CHOICES = 8  # places to choose from, the one that hides the most pieces
SPARE = 1.15  # on the fewest pixels of a piece, which are counted in a small picture
MARGIN: dict[Rule, float] = {
    "wall": 0.06, "corner": 0.05, "middle": 0.5, "facing": 0.45, "before": 0.1, "around": 0.04,
    "beside": 0.04,
}  # fmt: skip
"""Free floor around a piece, by where it stands [m]."""


def make_view(
    size: tuple[int, int], height: float, pitch: float, roll: float, fov: float
) -> Viewpoint:
    """A camera of a width and height [px] above the floor [m], with its angles [rad]."""
    focal = size[0] / 2 / np.tan(fov / 2)
    K = torch.tensor([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    turn = tilted(torch.tensor(pitch, dtype=torch.float64), torch.tensor(roll, dtype=torch.float64))
    return Viewpoint(Camera(K.float(), turn.float(), *size), height)


def draw_view(rng: np.random.Generator, size: tuple[int, int], config: PlanConfig) -> Viewpoint:
    """A camera as a person would put it up: the higher, the more it looks down."""
    height = float(rng.uniform(*config.camera_height))
    pitch = -np.radians(rng.uniform(*config.look_down) + 4 * (height - 1.2))
    roll = np.radians(rng.uniform(-2, 2))
    fov = np.radians(rng.uniform(*config.field_of_view))
    return make_view(size, height, float(pitch), float(roll), float(fov))


def draw_plan(rng: np.random.Generator, config: RoomConfig) -> Plan:
    """A room of a random kind, many of whose objects are partly occluded."""
    kind = sorted(KINDS)[int(rng.integers(len(KINDS)))]
    wanted = (*KINDS[kind], *config.plan.more)[: config.pieces]
    best, most_hidden = None, -1.0
    for _ in range(ROUNDS):
        plan, value = _furnished(rng, wanted, config)
        if best is None or value > most_hidden:
            best, most_hidden = plan, value
        if most_hidden >= config.plan.crowded * len(best.pieces):
            break
    assert best is not None, "there is at least one round"
    return best


def _furnished(
    rng: np.random.Generator, wanted: tuple[tuple[str, Rule], ...], config: RoomConfig
) -> tuple[Plan, float]:
    """One room, and how many of its objects are well occluded."""
    view = draw_view(rng, (config.width, config.height), config.plan)
    wide, deep = float(rng.uniform(4.6, 5.4)), float(rng.uniform(5.6, 6.4))  # of the floor [m]
    plan, value = Plan((), view, (-wide / 2, -deep), (wide / 2, -1.9)), 0.0
    few = SPARE * config.least_pixels * (WIDTH / config.width) ** 2
    drawn: list[Float[Tensor, "h w"]] = []
    for name, rule in wanted:
        spots = _spots(plan, name, rule, rng, config.plan)
        looks = [depth_of(spot, view) for spot in spots]
        values = [worth([*drawn, look], few, config.plan.hidden) for look in looks]
        best = int(np.argmax(values)) if values else -1
        if best >= 0 and values[best] >= 0:
            drawn, value = [*drawn, looks[best]], values[best]
            plan = replace(plan, pieces=(*plan.pieces, spots[best]))
    return plan, value


def _spots(
    plan: Plan, name: str, rule: Rule, rng: np.random.Generator, config: PlanConfig
) -> list[Placed]:
    """Up to `CHOICES` positions where a new object stands free and in view."""
    furniture = make_piece(name, rng)
    others = list(plan.pieces)
    count = sum(p.furniture.category == furniture.category for p in others)
    label = f"{furniture.category.replace(' ', '_')}_{count}"
    found: list[Placed] = []
    for _ in range(TRIES):
        spot = _drawn(rule, rng, furniture.size, plan.walls, others)
        if spot is None or len(found) == CHOICES:
            break
        turn = 0.0
        if config.askew[1]:
            turn = np.radians(rng.uniform(*config.askew)) * rng.choice([-1, 1])
        piece = Placed(label, furniture, spot[:2], spot[2] + float(turn))
        free = fits(piece, others, config.spacing * MARGIN[rule], plan.walls)
        if free and in_view(piece, plan.view) >= config.visible:
            found.append(piece)
    return found


def in_view(piece: Placed, view: Viewpoint) -> float:
    """Share of the vertices that the image holds."""
    cam = view.seen(verts_on_floor(piece))
    pixel = project(cam, view.camera.K)
    size = torch.tensor([view.camera.width, view.camera.height])
    inside = ((pixel > 0) & (pixel < size)).all(-1) & (cam[:, 2] > 0.3)
    return float(inside.double().mean())


def fits(piece: Placed, others: list[Placed], margin: float, walls: np.ndarray) -> bool:
    """Whether a piece stands inside the walls and keeps a margin from others [m]."""
    own = corners(piece)
    if (own < walls[0] + 0.01).any() or (own > walls[1] - 0.01).any():
        return False
    return not any(overlap(piece, other, margin) for other in others)


def overlap(a: Placed, b: Placed, margin: float) -> bool:
    """Whether footprints come nearer than `margin` (along some edge's normal) [m]."""
    reach = (
        np.hypot(a.furniture.size[0], a.furniture.size[2])
        + np.hypot(b.furniture.size[0], b.furniture.size[2])
    ) / 2 + 2 * margin
    if np.hypot(*(a.place - b.place)) > reach:
        return False
    first, second = corners(a, margin / 2), corners(b, margin / 2)
    for axis in (*a.axes, *b.axes):
        p, q = first @ axis, second @ axis
        if p.max() < q.min() or q.max() < p.min():
            return False
    return True
