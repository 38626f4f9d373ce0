"""Let gravity act on a room: what stands well stays, what floats falls, what is stuck jumps.

MuJoCo simulates (the extra `physics`); it needs no truth. A second simulation puts the weight of
people on what they sit on, where they sat on it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.contact_labels import ContactLabels
from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.settings import float_in
from mover.core.types import Scene, SceneObject
from mover.evaluate.scene import Metric
from mover.geometry.rotations import rot_y
from mover.io.export.contacts import FILE, read_labels
from mover.io.export.mjcf import body_name, mjcf_of, text_of
from mover.io.export.solids import AXES, Solid, solids_of
from mover.io.files.npz import read_npz

MASS = 70.0  # [kg], of an adult whose weight nobody told
SEAT_SHARE = 0.85  # of a sitter's weight is on the seat, the rest on the feet
BEARING = ("seat", "left_thigh", "right_thigh")
SURE = 0.5  # confidence of the labels that count
BOUT = 1.0  # [s]; who sits again later may sit elsewhere
SHORTEST = 3  # frames of a bout
FPS = 5.0  # where no rate is known


@dataclass(frozen=True)
class Load:
    """Somebody's weight on an object."""

    id: str
    kilos: float
    place: Float[Tensor, "3"]
    """Where, as a share of the size along the axes of its mesh, from the mesh's origin [m]."""
    person: int
    frame: int
    """The first of the bout."""


def loads_of(out: Path, scene: Scene, fps: float | None) -> tuple[Load, ...]:
    """The weights of all bouts of sitting in a result; none without contacts.npz."""
    return loads_in(read_labels(out / FILE), scene, fps) if (out / FILE).is_file() else ()


def loads_in(labels: ContactLabels, scene: Scene, fps: float | None) -> tuple[Load, ...]:
    """The weights of all bouts of sitting that the labels of a scene tell."""
    names = torch.tensor([name in BEARING for name in labels.parts])
    bears = names[labels.part] & (labels.confidence >= SURE)
    found: list[Load] = []
    for piece in scene.objects:
        if piece.id not in labels.objects:
            continue
        mine = bears & (labels.object == labels.objects.index(piece.id))
        for person in labels.person[mine].unique().tolist():
            found += _bouts(labels, mine & (labels.person == person), piece, fps or FPS)
    return tuple(found)


def _bouts(
    labels: ContactLabels, mine: Bool[Tensor, " rows"], piece: SceneObject, fps: float
) -> list[Load]:
    """One weight for each span in which a person sits on an object."""
    frames = labels.frame[mine].unique()
    breaks = (frames.diff() > BOUT * fps).nonzero()[:, 0] + 1
    found: list[Load] = []
    for span in torch.tensor_split(frames, breaks):
        if len(span) < SHORTEST:
            continue
        rows = mine & (labels.frame >= span[0]) & (labels.frame <= span[-1])
        share = labels.confidence[rows] / labels.confidence[rows].sum()
        middle = (share[:, None] * labels.position[rows]).sum(0)
        own = rot_y(-piece.yaw) @ (middle - piece.t_world_object).to(piece.yaw) / piece.scale
        person = int(labels.person[rows][0])
        found.append(Load(piece.id, MASS * SEAT_SHARE, own, person, int(span[0])))
    return found


def hardest(loads: tuple[Load, ...], piece: SceneObject) -> Load | None:
    """The bout farthest from the middle of an object's mesh, which tips it the most."""
    mine = [load for load in loads if load.id == piece.id]
    if not mine:
        return None
    verts = piece.mesh.verts
    middle = (verts.amin(0) + verts.amax(0)) / 2

    def lever(load: Load) -> float:
        away = (load.place - middle) * piece.scale
        return float(away[[0, 2]].norm())

    return max(mine, key=lever)


# The simulation.


TOPPLED = math.radians(45)  # [rad]
STAYS = (0.01, math.radians(1))  # [m], [rad]; less is stable; such a share is REST3D's (2026)


@dataclass(frozen=True)
class SimulationConfig:
    """How long gravity acts."""

    seconds: Annotated[float, float_in(0.01, 3600)] = 2.0
    """Time of the simulation."""


@dataclass(frozen=True)
class SimulatedObject:
    """How far one piece went."""

    id: str
    category: str
    moved: float
    """Distance of its box's centre from where it was [m]."""
    fell: float
    """How far it went down, negative: up [m]."""
    turned: float
    """Angle between its attitudes [rad]."""
    tilted: float
    """Angle of its upright axis to the vertical [rad]."""
    stuck: float
    """How deep it was inside the floor or others at first [m]."""
    mass: float
    """[kg]"""
    fixed: bool
    """True: it hangs or is built in (`support` is free), so it was held."""
    load: float = 0.0
    """What people put on it where they sat on it [kg]; 0: nobody sat on it."""
    moved_loaded: float = 0.0
    """How far it moves under that weight [m]."""
    turned_loaded: float = 0.0
    """... and turns [rad]."""

    @property
    def stays(self) -> bool:
        """Whether it moves less than 1 cm and turns less than a degree, also under sitters."""
        moved = max(self.moved, self.moved_loaded)
        return moved < STAYS[0] and max(self.turned, self.turned_loaded) < STAYS[1]

    @property
    def toppled(self) -> bool:
        """Whether it fell over."""
        return self.tilted > TOPPLED


def lacking() -> str | None:
    """What has to be installed for a simulation; None: nothing."""
    if find_spec("mujoco") is not None:
        return None
    return "mujoco is not installed; pip install '.[physics]' in mover's folder"


def simulate(
    scene: Scene,
    run: Run,
    config: SimulationConfig | None = None,
    loads: tuple[Load, ...] = (),
) -> tuple[SimulatedObject, ...]:
    """Simulate a scene in MuJoCo and compare where its pieces end with where they were.

    Args:
        scene: Initial, result or truth; without a floor, its lowest point is on one.
        run: Its folder keeps the convex pieces.
        config: How long.
        loads: Who sits where; each object gets the hardest of its loads, in a second simulation.

    Raises:
        InputError: If mujoco is not installed.
    """
    if (missing := lacking()) is not None:
        raise InputError(missing)
    config = config or SimulationConfig()
    solids = solids_of(scene, run)
    room = _Standing(scene, solids)
    start, end, stuck = _settled(room, config.seconds, {})
    found = [_compare(*row) for row in zip(solids, start, end, stuck, strict=True)]
    pressed = {p.id: load for p in scene.objects if (load := hardest(loads, p)) is not None}
    if not pressed:
        return tuple(found)
    _, under, _ = _settled(room, config.seconds, pressed)
    for k, solid in enumerate(solids):
        if solid.id in pressed:
            heavy = _compare(solid, start[k], under[k], stuck[k])
            found[k] = replace(
                found[k], load=pressed[solid.id].kilos, moved_loaded=heavy.moved,
                turned_loaded=heavy.turned,
            )  # fmt: skip
    return tuple(found)


@dataclass(frozen=True)
class _Standing:
    """What is simulated."""

    scene: Scene
    solids: tuple[Solid, ...]


def modelled(scene: Scene, solids: tuple[Solid, ...]) -> tuple[Any, Any, Any]:
    """MuJoCo, its model of a scene without looks, and the data of that model at the start."""
    mujoco: Any = import_module("mujoco")
    root, meshes = mjcf_of(scene, solids, looks=False)
    model = mujoco.MjModel.from_xml_string(text_of(root), meshes)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return mujoco, model, data


def _settled(
    room: _Standing, seconds: float, pressed: Mapping[str, Load]
) -> tuple[list["State"], list["State"], list[float]]:
    """Where the pieces are before and after, and how deep they were stuck."""
    scene, solids = room.scene, room.solids
    mujoco, model, data = modelled(scene, solids)
    start = _states(data, solids)
    stuck = [_stuck(model, data, body_name(solid)) for solid in solids]
    weights: list[tuple[int, float, NDArray[np.float64]]] = []  # places in the bodies' axes [m]
    for solid, piece in zip(solids, scene.objects, strict=True):
        if (load := pressed.get(solid.id)) is not None:
            place = (AXES @ (load.place * piece.scale).double()).numpy()
            weights.append((model.body(body_name(solid)).id, load.kilos, place))
    for _ in range(round(seconds / model.opt.timestep)):
        for body, kilos, place in weights:
            _press(data, body, (kilos * abs(float(model.opt.gravity[2])), place))
        mujoco.mj_step(model, data)
    return start, _states(data, solids), stuck


def _press(data: Any, body: int, by: tuple[float, NDArray[np.float64]]) -> None:  # noqa: ANN401
    """Push a body down with a force [N] at a point of its own."""
    force, place = by
    point = data.xmat[body].reshape(3, 3) @ place + data.xpos[body]
    data.xfrc_applied[body] = 0
    lever = point - data.xipos[body]
    down = np.array([0.0, 0.0, -force])
    data.xfrc_applied[body, :3] = down
    data.xfrc_applied[body, 3:] = np.cross(lever, down)


State = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Place of the mesh's origin [m] and rotation of a body."""


def _states(data: Any, solids: tuple[Solid, ...]) -> list[State]:  # noqa: ANN401
    found: list[State] = []
    for solid in solids:
        body = data.body(body_name(solid))
        found.append((np.array(body.xpos), np.array(body.xmat).reshape(3, 3)))
    return found


def _stuck(model: Any, data: Any, name: str) -> float:  # noqa: ANN401
    """Depth of the deepest contact of a body [m]."""
    body, deepest = model.body(name).id, 0.0
    for contact in data.contact[: data.ncon]:
        owners = {int(model.geom_bodyid[geom]) for geom in contact.geom}
        if body in owners:
            deepest = max(deepest, -float(contact.dist))
    return deepest


def _compare(solid: Solid, start: State, end: State, stuck: float) -> SimulatedObject:
    verts = torch.cat([hull.verts for hull in solid.hulls]).numpy()
    centre = (verts.min(0) + verts.max(0)) / 2
    before, after = (turn @ centre + place for place, turn in (start, end))
    between = np.clip((np.trace(end[1] @ start[1].T) - 1) / 2, -1, 1)
    return SimulatedObject(
        id=solid.id,
        category=solid.category,
        moved=float(np.linalg.norm(after - before)),
        fell=float(before[2] - after[2]),
        turned=math.acos(float(between)),
        tilted=math.acos(float(np.clip(end[1][2, 2], -1, 1))),
        stuck=stuck,
        mass=solid.mass,
        fixed=not solid.free,
    )


def result_loads(out: Path, scene: Scene) -> tuple[Load, ...]:
    """Who sits where in a result."""
    return loads_of(out, scene, _rate(out))


def _rate(out: Path) -> float | None:
    """Frames a second of the result's people."""
    file = out / "bodies.npz"
    found = read_npz(file).value.get("fps") if file.is_file() else None
    return None if found is None or not float(found) > 0 else float(found)


def stable_share(found: Sequence[SimulatedObject]) -> float | None:
    """Share of the pieces that could move which stay; None: nothing could."""
    loose = [row.stays for row in found if not row.fixed]
    return sum(loose) / len(loose) if loose else None


PHYSICS_METRICS: dict[str, Metric[Sequence[SimulatedObject]]] = {
    "stable": Metric("", 1.0, stable_share)
}
