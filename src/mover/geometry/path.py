"""A camera that moves: its pose in each frame, and points that follow it."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.types import CameraPath
from mover.geometry.camera import at_pixels, project
from mover.geometry.rotations import axis_angle, rotation_vectors


def is_still(path: CameraPath) -> bool:
    """Whether there is one pose for all frames."""
    return len(path.frame) == 1


def scaled(path: CameraPath, factor: float) -> CameraPath:
    """The path in other units."""
    return replace(path, t_reference_camera=path.t_reference_camera * factor)


def poses_at(path: CameraPath, frame: Int[Tensor, " rows"]) -> CameraPath:
    """The poses of some frames; evenly between two known ones, at the ends' beyond them."""
    R, t = path.R_reference_camera, path.t_reference_camera
    if is_still(path):
        return CameraPath(frame, R.expand(len(frame), 3, 3), t.expand(len(frame), 3))
    after = torch.searchsorted(path.frame, frame.contiguous()).clamp(1, len(path.frame) - 1)
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


def resampled(
    image: Bool[Tensor, "images h w"],
    depth: Float[Tensor, "*depths wh ww"],
    views: tuple[Float[Tensor, "3 3"], tuple[slice, slice]],
    pose: CameraPath,
) -> Bool[Tensor, "images *depths wh ww"]:
    """Images of another camera where it sees the surface that this one sees at each pixel.

    Both have the same intrinsics, which `views` has with the rows and columns of the window in
    which the depth [m] is known; the one pose is that of the other camera in the axes of this one.
    """
    K, (rows, columns) = views
    y, x = (
        torch.arange(rows.start, rows.stop) + 0.5,
        torch.arange(columns.start, columns.stop) + 0.5,
    )
    pixel = torch.stack(torch.broadcast_tensors(x, y[:, None], torch.ones(())), -1)
    points = (pixel @ torch.linalg.inv(K).mT) * depth[..., None]
    there = project(from_reference(points.flatten(0, -2)[None], pose)[0], K).floor().long()
    found, inside = at_pixels(image, there)
    return (found & inside).unflatten(-1, depth.shape)
