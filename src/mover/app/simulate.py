"""Let gravity act on a room: what stands well stays, what floats falls, what is stuck jumps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.types import Scene
from mover.io.capture.scene_file import read_scene
from mover.io.export.mjcf import body_name, mjcf_of, text_of
from mover.io.export.solids import Solid, solids_of
from mover.io.files.fields import write_json

TOPPLED = math.radians(45)  # [rad]


@dataclass(frozen=True)
class SimulationConfig:
    """How long gravity acts."""

    seconds: float = 3.0
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

    @property
    def toppled(self) -> bool:
        """Whether it fell over."""
        return self.tilted > TOPPLED


def simulate(
    scene: Scene, run: Run, config: SimulationConfig | None = None
) -> tuple[SimulatedObject, ...]:
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
            "mover simulate: mujoco is not installed; pip install '.[physics]' in mover's folder"
        )
    mujoco: Any = import_module("mujoco")
    config = config or SimulationConfig()
    solids = solids_of(scene, run)
    root, meshes = mjcf_of(scene, solids, looks=False)
    model = mujoco.MjModel.from_xml_string(text_of(root), meshes)
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


def simulate_folder(
    out: Path, truth: Path | None = None, config: SimulationConfig | None = None
) -> dict[str, tuple[SimulatedObject, ...]]:
    """Simulate the initial scene, the result and, where given, the truth; writes `settle.json`.

    Args:
        out: Folder of a result.
        truth: Folder with the true scene.json.
        config: How long.

    Raises:
        InputError: If there is no result, or mujoco is not installed.
    """
    config, run = config or SimulationConfig(), Run(out)
    files = {"initial": out / "initial.json", "result": out / "scene.json"}
    files = {name: file for name, file in files.items() if name == "result" or file.is_file()}
    if truth is not None:
        files["truth"] = truth / "scene.json"
    found: dict[str, tuple[SimulatedObject, ...]] = {}
    for name, file in files.items():
        home = run if name != "truth" else Run(out / "stages" / "truth")
        found[name] = simulate(read_scene(file), home, config)
    tree: dict[str, Any] = {"format": "mover-settle", "version": 1, "seconds": config.seconds}
    scenes = {
        name: [{**asdict(row), "toppled": row.toppled} for row in rows]
        for name, rows in found.items()
    }
    write_json({**tree, "scenes": scenes}, out / "settle.json")
    return found


# The settle test as text.


HEADS = ("moved", "turned", "stuck", "")
WIDTHS = (9, 9, 8, 10)


def simulation_table(found: Mapping[str, Sequence[SimulatedObject]]) -> str:
    """For each piece, how far it moved, turned and was stuck, in each scene."""
    ids = list(dict.fromkeys(row.id for rows in found.values() for row in rows))
    width = max([len("object"), *map(len, ids)])
    heads = "".join(f"   {name:<{sum(WIDTHS)}}" for name in found)
    lines = [f"{'':<{width}}{heads}", f"{'object':<{width}}{_row(HEADS) * len(found)}"]
    for name in ids:
        cells = [_cell(next((r for r in rows if r.id == name), None)) for rows in found.values()]
        lines.append(f"{name:<{width}}{''.join(cells)}")
    sums = [_summary(name, rows) for name, rows in found.items()]
    return "\n".join(line.rstrip() for line in (*lines, "", *sums))


def _row(words: Sequence[str]) -> str:
    return "   " + "".join(f"{w:<{size}}" for w, size in zip(words, WIDTHS, strict=True))


def _cell(row: SimulatedObject | None) -> str:
    if row is None or row.fixed:
        return _row(("-" if row is None else "held", "", "", ""))
    moved, stuck = f"{1e3 * row.moved:.0f} mm", f"{1e3 * row.stuck:.0f} mm"
    turned = f"{math.degrees(row.turned):.0f} deg"
    return _row((moved, turned, stuck, "fell over" if row.toppled else ""))


def _summary(name: str, rows: Sequence[SimulatedObject]) -> str:
    loose = [row for row in rows if not row.fixed]
    if not loose:
        return f"{name}: nothing that could move"
    far = sorted(row.moved for row in loose)
    over = sum(row.toppled for row in loose)
    middle, most = 1e3 * far[len(far) // 2], 1e3 * far[-1]
    return f"{name}: median {middle:.0f} mm, most {most:.0f} mm, {over} of {len(loose)} fell over"
