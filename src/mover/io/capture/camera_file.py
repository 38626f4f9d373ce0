"""The camera of camera.json and scene.json."""

import dataclasses
from typing import Any

import numpy as np
import torch
from msgspec import Struct

from mover.core.types import Camera
from mover.geometry.camera import heading, pitch_roll
from mover.geometry.rotations import rot_y
from mover.io.files.fields import At, Warn, get, maybe, plain, refuse
from mover.io.files.schema import Number, Positive, Rows, Side, checked, rotation

LARGEST_AREA = 1 << 28  # [px²]
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
STEEPEST = 1.4  # [rad], beyond it a camera has no heading to speak of
NO_TURN = 1e-6  # [rad]
LEVEL = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


class CameraFields(Struct, frozen=True):
    """camera.json, and `camera` of scene.json; lengths in pixels."""

    w: Side
    h: Side
    fl_x: Positive
    fl_y: Positive
    cx: Number
    cy: Number
    R_cam_world: Rows | None = None


def camera_of(at: At, other: Camera | None = None) -> Camera:
    """The camera of a JSON object, with its rotation as given (its heading is kept).

    Args:
        at: The object.
        other: Its rotation is taken where `at` has none; without it the camera is level.

    Raises:
        InputError: If a field is wrong.
    """
    lens = checked(at, CameraFields)
    if lens.w * lens.h > LARGEST_AREA:
        found = f"{lens.w} x {lens.h}"
        refuse(get(at, "w"), f"an image of at most {LARGEST_AREA} pixels", found)
    for key in DISTORTION:
        given = maybe(at, key)
        if given is not None and checked(given, Number) != 0:
            refuse(given, "an image without distortion (0): undistort the images first")
    K = torch.tensor([[lens.fl_x, 0.0, lens.cx], [0.0, lens.fl_y, lens.cy], [0.0, 0.0, 1.0]])
    if lens.R_cam_world is not None:
        turn = torch.from_numpy(rotation(get(at, "R_cam_world")).astype(np.float32))
    else:
        turn = LEVEL if other is None else other.R_cam_world
    return Camera(K, turn, lens.w, lens.h)


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
