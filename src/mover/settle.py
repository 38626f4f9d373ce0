"""Let gravity act on a room: what stands well stays, what floats falls, what is stuck jumps."""

import math
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .exporters.mjcf import body_name, mjcf_of
from .exporters.solids import Solid, solids_of
from .readers.fields import write_json
from .readers.scene_file import read_scene
from .records import InputError
from .run import Run
from .types import Scene

TOPPLED = math.radians(45)  # [rad]


@dataclass(frozen=True)
class SettleConfig:
    """How long gravity acts."""

    seconds: float = 3.0
    """Time of the simulation."""


@dataclass(frozen=True)
class Settled:
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

    @property
    def toppled(self) -> bool:
        """Whether it fell over."""
        return self.tilted > TOPPLED


def settle(scene: Scene, run: Run, config: SettleConfig | None = None) -> tuple[Settled, ...]:
    """Simulate a scene in MuJoCo and compare where its pieces end with where they were.

    Args:
        scene: Initial, result or truth; without a floor, its lowest point is on one.
        run: Its folder keeps the convex pieces.
        config: How long.

    Raises:
        InputError: If mujoco is not installed.
    """
    if find_spec("mujoco") is None:
        raise InputError(
            "mover settle: mujoco is not installed; pip install '.[physics]' in mover's folder"
        )
    mujoco: Any = import_module("mujoco")
    config = config or SettleConfig()
    solids = solids_of(scene, run)
    text, meshes = mjcf_of(scene, solids, looks=False)
    model = mujoco.MjModel.from_xml_string(text, meshes)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = _states(data, solids)
    stuck = [_stuck(model, data, body_name(solid)) for solid in solids]
    for _ in range(round(config.seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    end = _states(data, solids)
    return tuple(_compare(*row) for row in zip(solids, start, end, stuck, strict=True))


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


def _compare(solid: Solid, start: State, end: State, stuck: float) -> Settled:
    verts = torch.cat([hull.verts for hull in solid.hulls]).numpy()
    centre = (verts.min(0) + verts.max(0)) / 2
    before, after = (turn @ centre + place for place, turn in (start, end))
    between = np.clip((np.trace(end[1] @ start[1].T) - 1) / 2, -1, 1)
    return Settled(
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


def settle_folder(
    out: Path, truth: Path | None = None, config: SettleConfig | None = None
) -> dict[str, tuple[Settled, ...]]:
    """Settle the initial scene, the result and, where given, the truth; writes `settle.json`.

    Args:
        out: Folder of a result.
        truth: Folder with the true scene.json.
        config: How long.

    Raises:
        InputError: If there is no result, or mujoco is not installed.
    """
    config, run = config or SettleConfig(), Run(out)
    files = {"initial": out / "initial.json", "result": out / "scene.json"}
    files = {name: file for name, file in files.items() if name == "result" or file.is_file()}
    if truth is not None:
        files["truth"] = truth / "scene.json"
    found: dict[str, tuple[Settled, ...]] = {}
    for name, file in files.items():
        home = run if name != "truth" else Run(out / "stages" / "truth")
        found[name] = settle(read_scene(file), home, config)
    tree: dict[str, Any] = {"format": "mover-settle", "version": 1, "seconds": config.seconds}
    scenes = {
        name: [{**asdict(row), "toppled": row.toppled} for row in rows]
        for name, rows in found.items()
    }
    write_json({**tree, "scenes": scenes}, out / "settle.json")
    return found
