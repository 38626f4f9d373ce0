"""The camera of camera.json and scene.json."""

import dataclasses
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.camera import heading, pitch_roll
from ..geometry.rotations import rot_y
from ..types import Camera
from .fields import At, Warn, get, integer, maybe, number, plain, positive, refuse, rotation

LARGEST_SIDE = 32768  # [px]
LARGEST_AREA = 1 << 28  # [px²]
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
STEEPEST = 1.4  # [rad], beyond it a camera has no heading to speak of
NO_TURN = 1e-6  # [rad]


def camera_of(at: At, other: Camera | None = None) -> Camera:
    """The camera of a JSON object, with its rotation as given (its heading is kept).

    Args:
        at: The object.
        other: Its rotation is taken where `at` has none; without it the camera is level.

    Raises:
        InputError: If a field is wrong.
    """
    width, height = (integer(get(at, key), 1, LARGEST_SIDE) for key in ("w", "h"))
    if width * height > LARGEST_AREA:
        refuse(get(at, "w"), f"an image of at most {LARGEST_AREA} pixels", f"{width} x {height}")
    fx, fy = positive(get(at, "fl_x")), positive(get(at, "fl_y"))
    cx, cy = number(get(at, "cx")), number(get(at, "cy"))
    for key in DISTORTION:
        given = maybe(at, key)
        if given is not None and number(given):
            refuse(given, "an image without distortion (0): undistort the images first")
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(K, _rotation_of(at, other), width, height)


def _rotation_of(at: At, other: Camera | None) -> Float[Tensor, "3 3"]:
    """The rotation of a camera object, of the other camera, or of a level camera."""
    given = maybe(at, "R_cam_world")
    if given is not None:
        return torch.from_numpy(rotation(given).astype(np.float32))
    return torch.diag(torch.tensor([1.0, -1.0, -1.0])) if other is None else other.R_cam_world


def turned(camera: Camera) -> tuple[Camera, float]:
    """The camera in the world without heading, and the angle that turns the world so [rad]."""
    R = camera.R_cam_world.double()
    angle = heading(R)
    if abs(angle) < NO_TURN:
        return camera, 0.0
    R_new = R @ rot_y(torch.tensor(angle, dtype=R.dtype)).mT
    return dataclasses.replace(camera, R_cam_world=R_new.to(camera.R_cam_world)), angle


def check_attitude(camera: Camera, place: str, warn: Warn) -> None:
    """Warn of a camera that stands on its head or looks straight up or down."""
    pitch, roll = (float(v) for v in pitch_roll(camera.R_cam_world))
    if abs(pitch) > STEEPEST:
        warn(f"{place}: the camera looks straight up or down (pitch {pitch:.2f} rad)")
    elif abs(roll) > STEEPEST:
        axes = "x_cam = R_cam_world @ x_world, world +y up, camera x right, y down, z forward"
        warn(f"{place}: the camera is turned on its side or head (roll {roll:.2f} rad); {axes}")


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """The JSON object of a camera."""
    K = plain(camera.K)
    return {
        "w": camera.width, "h": camera.height,
        "fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2],
        "R_cam_world": plain(camera.R_cam_world),
    }  # fmt: skip
