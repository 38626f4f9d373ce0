"""The share of a scene's objects that stay under gravity, in MuJoCo (the extra `physics`)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.types import Scene
from mover.evaluate.scene import Metric
from mover.io.export.solids import Solid, body_name, mjcf_of, solids_of, text_of

SECONDS = 2.0  # [s] of gravity
STAYS = (0.01, math.radians(1))  # [m], [rad]; less is stable; such a share is REST3D's (2026)
State = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Position of a mesh's origin [m] and rotation of its body."""


@dataclass(frozen=True)
class Settled:
    """How far one object went."""

    id: str
    moved: float  #: Distance of its box's centre from where it was [m]
    turned: float  #: Angle between its attitudes [rad]
    fixed: bool  #: True: it hangs or is built in (`support` is free), so it was held

    @property
    def stays(self) -> bool:
        """Whether it moves less than 1 cm and turns less than a degree."""
        return self.moved < STAYS[0] and self.turned < STAYS[1]


def lacking() -> str | None:
    """What has to be installed for a simulation; None: nothing."""
    if find_spec("mujoco") is not None:
        return None
    return "mujoco is not installed; pip install -e '.[physics]' in mover's folder"


def settle(scene: Scene, run: Run, seconds: float = SECONDS) -> tuple[Settled, ...]:
    """Simulate a scene and compare where its objects end with where they were.

    Without a floor its lowest point is on one. The run's folder keeps the convex parts.

    Raises:
        InputError: If mujoco is not installed.
    """
    if (missing := lacking()) is not None:
        raise InputError(missing)
    mujoco: Any = import_module("mujoco")
    solids = solids_of(scene, run)
    root, meshes = mjcf_of(scene, solids, looks=False)
    model = mujoco.MjModel.from_xml_string(text_of(root), meshes)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    start = [_state(data, solid) for solid in solids]
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    found: list[Settled] = []
    for solid, before in zip(solids, start, strict=True):
        after = _state(data, solid)
        verts = torch.cat([hull.verts for hull in solid.hulls]).numpy()
        centre = (verts.min(0) + verts.max(0)) / 2
        way = (after[1] @ centre + after[0]) - (before[1] @ centre + before[0])
        cosine = float(np.clip((np.trace(after[1] @ before[1].T) - 1) / 2, -1, 1))
        moved = float(np.linalg.norm(way))
        found.append(Settled(solid.id, moved, math.acos(cosine), not solid.free))
    return tuple(found)


def _state(data: Any, solid: Solid) -> State:  # noqa: ANN401
    body = data.body(body_name(solid))
    return np.array(body.xpos), np.array(body.xmat).reshape(3, 3)


def stable_share(found: Sequence[Settled]) -> float | None:
    """Share of the objects that could move which stay; None: nothing could."""
    loose = [row.stays for row in found if not row.fixed]
    return sum(loose) / len(loose) if loose else None


PHYSICS_METRICS: dict[str, Metric[Sequence[Settled]]] = {
    "stable": Metric("Objects that stay under gravity", "share", 1.0, stable_share)
}
