"""What a tool's gravity gives: bodies in the upright world, and a camera with pitch and roll."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry.camera import pitch_roll
from ...records import InputError
from ...types import Bodies, Camera
from ..pose_file import into_camera
from .finish import Imported
from .gravity import level
from .known import Known


def attitude(up: Float[Tensor, "3"]) -> tuple[float, float]:
    """Pitch and roll of the camera that sees this as up [rad]."""
    pitch, roll = pitch_roll(level(up))
    return float(pitch), float(roll)


def in_world(found: Imported, file: str) -> Bodies:
    """The bodies in the world without heading, +y up, the camera at its origin.

    Raises:
        InputError: If the tool does not tell gravity.
    """
    if found.up is None:
        raise InputError(f"{file}: tells no gravity, expected --space camera")
    R = level(found.up)
    given = dataclasses.replace(found.bodies, space="world")
    return dataclasses.replace(into_camera(given, R.mT), space="world")


def camera_from(found: Imported, known: Known) -> Camera:
    """The camera: the user's lens, else the tool's, with pitch and roll by the tool's gravity.

    Raises:
        InputError: If no lens is known.
    """
    if found.K is None:
        raise InputError("--write-camera: the tool tells no lens, expected --camera as well")
    R = torch.diag(torch.tensor([1.0, -1.0, -1.0])) if found.up is None else level(found.up)
    if known.camera is not None:
        return dataclasses.replace(known.camera, R_cam_world=R)
    width, height = (round(2 * float(v)) for v in found.K[:2, 2])
    return Camera(found.K, R, width, height)
