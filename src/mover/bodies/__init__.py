"""People's bodies: models by name, from shape and pose to vertices and joints."""

from collections.abc import Callable
from functools import partial
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Int
from torch import Tensor

from mover.bodies.skinning import Posed, open_body
from mover.bodies.smpl_files import load_smpl
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import BodyPose


@runtime_checkable
class BodyModel(Protocol):
    """What a body model can do."""

    @property
    def name(self) -> str:
        """Its name in `BODY_MODELS`."""
        ...

    @property
    def faces(self) -> Int[Tensor, "faces 3"]:
        """Triangles of its surface, counter-clockwise from outside."""
        ...

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of its joints, in order."""
        ...

    def posed(self, pose: BodyPose) -> Posed:
        """Vertices and joints [m], differentiable in all of `pose`."""
        ...


def run_model(model: BodyModel, pose: BodyPose, rows: int = 128) -> Posed:
    """Vertices and joints, some rows at a time to bound the memory [m]."""
    with torch.no_grad():
        parts = [model.posed(rows_of(pose, r)) for r in torch.arange(len(pose.transl)).split(rows)]
    return torch.cat([verts for verts, _ in parts]), torch.cat([joints for _, joints in parts])


BODY_MODELS: dict[str, Callable[[str], BodyModel]] = {
    "makehuman": lambda _: open_body(),  # its gender is part of its shape
    "smpl": partial(load_smpl, "smpl"),
    "smplh": partial(load_smpl, "smplh"),
    "smplx": partial(load_smpl, "smplx"),
}
"""How to get each body model, by name, from a gender; all but the first need the user's files."""


def load_model(name: str, gender: str = "neutral") -> BodyModel:
    """The body model with this name.

    Raises:
        InputError: If there is no such model, or its licensed files are not there.
    """
    if name not in BODY_MODELS:
        known = ", ".join(f"'{n}'" for n in sorted(BODY_MODELS))
        raise InputError(
            f"bodies.npz: 'model' is '{name}', known are {known}; "
            "meshes ('vertices' and 'faces') are enough without a model"
        )
    return BODY_MODELS[name](gender)
