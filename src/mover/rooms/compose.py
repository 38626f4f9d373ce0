"""Furnish a room: what stands where, and from where the camera sees it."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..furniture import make_piece
from ..geometry.camera import project, tilted, to_camera
from ..records import record
from ..types import Camera
from .crowding import WIDTH, depth_of, worth
from .placed import Placed, corners, verts_on_floor
from .room_config import PlanConfig
from .spots import RULES, Rule
from .turns import facing, left_of


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

ROUNDS = 5  # rooms to choose from
TRIES = 40
CHOICES = 8  # places to choose from, the one that hides the most pieces
SPARE = 1.15  # on the fewest pixels of a piece, which are counted in a small picture
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


def draw_view(rng: np.random.Generator, size: tuple[int, int], config: PlanConfig) -> View:
    """A camera as somebody would put it up: the higher, the more it looks down."""
    height = float(rng.uniform(*config.camera_height))
    pitch = -np.radians(rng.uniform(*config.look_down) + 4 * (height - 1.2))
    roll = np.radians(rng.uniform(-2, 2))
    fov = np.radians(rng.uniform(*config.field_of_view))
    return make_view(size, (height, float(pitch), float(roll), float(fov)))


def draw_plan(
    rng: np.random.Generator,
    size: tuple[int, int],
    most: int,
    least: int,
    config: PlanConfig | None = None,
) -> Plan:
    """A room of a random kind, many of whose pieces are partly hidden.

    Args:
        rng: Source of randomness.
        size: Width and height of the image [px].
        most: Most pieces.
        least: Fewest pixels that each piece shows.
        config: How it is furnished and seen.
    """
    config = config or PlanConfig()
    kind = sorted(KINDS)[int(rng.integers(len(KINDS)))]
    best, most_hidden = None, -1.0
    for _ in range(ROUNDS):
        wanted = (*KINDS[kind], *config.more)[:most]
        plan, value = _furnished(rng, size, wanted, least, config)
        if best is None or value > most_hidden:
            best, most_hidden = plan, value
        if most_hidden >= config.crowded * len(best.pieces):
            break
    assert best is not None, "there is at least one round"
    return best


def _furnished(
    rng: np.random.Generator,
    size: tuple[int, int],
    wanted: tuple[tuple[str, Rule], ...],
    least: int,
    config: PlanConfig,
) -> tuple[Plan, float]:
    """One room, and how many of its pieces are well hidden."""
    view = draw_view(rng, size, config)
    wide, deep = float(rng.uniform(*config.wide)), float(rng.uniform(*config.far))
    low, high = (-wide / 2, -deep), (wide / 2, -1.9)
    plan, value = Plan((), view, low, high), 0.0
    few = SPARE * least * (WIDTH / size[0]) ** 2
    drawn: list[Float[Tensor, "h w"]] = []
    for what in wanted:
        spots = _spots(plan, what, rng, config)
        looks = [depth_of(spot, view.camera, view.height) for spot in spots]
        values = [worth([*drawn, look], few, config.hidden) for look in looks]
        best = int(np.argmax(values)) if values else -1
        if best >= 0 and values[best] >= 0:
            drawn, value = [*drawn, looks[best]], values[best]
            plan = dataclasses.replace(plan, pieces=(*plan.pieces, spots[best]))
    return plan, value


def _spots(
    plan: Plan, what: tuple[str, Rule], rng: np.random.Generator, config: PlanConfig
) -> list[Placed]:
    """Up to `CHOICES` places where a new piece stands free and in view."""
    name, rule = what
    furniture = make_piece(name, rng)
    others = list(plan.pieces)
    count = sum(p.furniture.category == furniture.category for p in others)
    label = f"{furniture.category.replace(' ', '_')}_{count}"
    found: list[Placed] = []
    for _ in range(TRIES):
        spot = RULES[rule](rng, furniture.size, plan.walls, others)
        if spot is None or len(found) == CHOICES:
            break
        piece = Placed(label, furniture, (spot[0], spot[1]), spot[2])
        free = _fits(piece, others, config.spacing * MARGIN[rule], plan.walls)
        if free and in_view(piece, plan.view) >= config.visible:
            found.append(piece)
    return found


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
    reach = (
        np.hypot(a.furniture.size[0], a.furniture.size[2])
        + np.hypot(b.furniture.size[0], b.furniture.size[2])
    ) / 2 + 2 * margin
    if np.hypot(*(a.place - b.place)) > reach:
        return False
    first, second = corners(a, margin / 2), corners(b, margin / 2)
    for heading in (a.heading, b.heading):
        for axis in (facing(np.array(heading)), left_of(np.array(heading))):
            p, q = first @ axis, second @ axis
            if p.max() < q.min() or q.max() < p.min():
                return False
    return True
