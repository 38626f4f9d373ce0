"""The pinhole camera: projection, pitch and roll, and worlds without heading."""

import math

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from mover.core.devices import constant
from mover.geometry.rotations import rot_x, rot_z

NEAR = 0.05  # [m], nothing nearer than this is drawn


def project(
    points_cam: Float[Tensor, "*batch 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 2"]:
    """Pixels of points in camera axes [m]; points behind the camera are held at `NEAR`."""
    uvw = torch.cat([points_cam[..., :2], points_cam[..., 2:].clamp_min(NEAR)], -1) @ K.mT
    return uvw[..., :2] / uvw[..., 2:]


def outermost(
    points_cam: Float[Tensor, "*batch points 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 4 3"]:
    """The points whose pixels lie leftmost, topmost, rightmost and lowest; the first of equals."""
    with torch.no_grad():
        pixels = project(points_cam, K)
        index = torch.cat([pixels.argmin(-2), pixels.argmax(-2)], -1)
    return points_cam.gather(-2, index.unsqueeze(-1).expand(*index.shape, 3))


def to_camera(
    points_world: Float[Tensor, "*batch 3"], R_cam_world: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 3"]:
    """World points in camera axes; the camera stands at the world's origin."""
    return points_world @ R_cam_world.mT


def to_world(
    points_cam: Float[Tensor, "*batch 3"], R_cam_world: Float[Tensor, "3 3"]
) -> Float[Tensor, "*batch 3"]:
    """Camera points in world axes."""
    return points_cam @ R_cam_world


def tilted(
    pitch: Float[Tensor, "*batch"], roll: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3 3"]:
    """R_cam_world of a camera with this pitch and roll [rad] and no heading (FORMAT.md)."""
    flip = constant(((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)), pitch)
    return flip @ rot_z(roll) @ rot_x(-pitch)


def pitch_roll(
    R_cam_world: Float[Tensor, "*batch 3 3"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Pitch (negative: looks down) and roll [rad] of the world's up-vector in the camera."""
    up = R_cam_world[..., :, 1]
    return up[..., 2].clamp(-1, 1).asin(), torch.atan2(-up[..., 0], -up[..., 1])


def heading(R_cam_world: Float[Tensor, "3 3"]) -> float:
    """Angle `a` [rad]: x_new = R_y(a) @ x_world turns the world so that the camera has none."""
    x, _, z = R_cam_world[2].tolist()
    return math.atan2(x, -z)


def at_pixels(
    images: Shaped[Tensor, "*images h w"], pixels: Int[Tensor, "*points 2"]
) -> tuple[Shaped[Tensor, "..."], Bool[Tensor, "*points"]]:
    """What images hold at pixels (x, y), and which of these lie in them; others mean nothing."""
    height, width = images.shape[-2:]
    x, y = pixels.unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return images[..., y.clamp(0, height - 1), x.clamp(0, width - 1)], inside
