"""A camera that moves: its pose in each frame, and points that follow it."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.types import CameraPath
from mover.geometry.rotations import axis_angle, rotation_vectors


def is_still(path: CameraPath) -> bool:
    """Whether there is one pose for all frames."""
    return len(path.frame) == 1


def scaled(path: CameraPath, factor: float) -> CameraPath:
    """The path in other units."""
    return replace(path, t_reference_camera=path.t_reference_camera * factor)


def poses_at(path: CameraPath, frame: Int[Tensor, " rows"]) -> CameraPath:
    """The poses of some frames, in their order; between two known ones evenly on the way.

    Args:
        path: The known poses.
        frame: Beyond the last known pose it is that of the end.
    """
    R, t = path.R_reference_camera, path.t_reference_camera
    if is_still(path):
        return CameraPath(frame, R.expand(len(frame), 3, 3), t.expand(len(frame), 3))
    after = torch.searchsorted(path.frame, frame).clamp(1, len(path.frame) - 1)
    first, last = path.frame[after - 1], path.frame[after]
    share = ((frame - first) / (last - first)).clamp(0, 1)[:, None].to(t)
    turn = rotation_vectors(R[after - 1].mT @ R[after])
    between = R[after - 1] @ axis_angle(share * turn)
    return CameraPath(frame, between, torch.lerp(t[after - 1], t[after], share))


def to_reference(
    points_cam: Float[Tensor, "rows points 3"], poses: CameraPath
) -> Float[Tensor, "rows points 3"]:
    """Points in the axes of the reference image's camera, one pose for each row."""
    R, t = (x.to(points_cam) for x in (poses.R_reference_camera, poses.t_reference_camera))
    return points_cam @ R.mT + t[:, None]


def from_reference(
    points: Float[Tensor, "rows points 3"], poses: CameraPath
) -> Float[Tensor, "rows points 3"]:
    """The way back: points in the axes of the camera that saw each row."""
    R, t = (x.to(points) for x in (poses.R_reference_camera, poses.t_reference_camera))
    return (points - t[:, None]) @ R
