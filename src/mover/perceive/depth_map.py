"""Metric depth of the picture, as Depth Anything, MoGe, UniDepth or Depth Pro give it."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera
from mover.energy.objective import ImageCues
from mover.energy.terms.depth import DepthRange
from mover.geometry.camera import to_world
from mover.geometry.crops import sample_nearest
from mover.io.files.fields import At, array, maybe, refuse
from mover.io.files.npz import read_npz
from mover.perceive.video import opened_picture

NAMES = ("depth", "depth_metric", "metric_depth", "predicted_depth", "depths", "arr_0")
FARTHEST = 100.0  # [m], what is farther is sky or nonsense
MILLIMETRES = 1000.0
LEVEL = 0.92  # cosine of the largest tilt of a surface that counts as floor
CELL = 0.04  # [m], height of a slice in which floor is counted
ENOUGH = 0.25  # of the fullest slice: the lowest slice with so much is the floor


def read_depth(path: Path, camera: Camera) -> Float[Tensor, "h w"]:
    """Distance along the view of each pixel [m]; NaN where it is unknown.

    `.npz` and `.npy` hold metres (`depth`, or MoGe's `points`, whose z counts); `.png` with 16
    bits holds millimetres. Another resolution of the same shape is stretched.

    Raises:
        InputError: If the file is something else.
    """
    match path.suffix.lower():
        case ".npz":
            values = _of_npz(path)
        case ".npy":
            from mover.io.files.npz import read_npy

            values = _two_axes(read_npy(path))
        case ".png":
            values = _of_png(path)
        case _:
            raise InputError(f"{path.name}: is no depth map, expected .npz, .npy or .png")
    known = np.isfinite(values) & (values > 0) & (values < FARTHEST)
    depth = torch.from_numpy(np.where(known, values, np.nan).astype(np.float32))
    h, w = depth.shape
    if abs(w * camera.height - h * camera.width) > 0.02 * w * camera.height:
        raise InputError(
            f"{path.name}: has {w} x {h} values, expected the shape of {camera.width} x "
            f"{camera.height} pixels"
        )
    rows = ((torch.arange(camera.height) + 0.5) * h / camera.height).long()
    columns = ((torch.arange(camera.width) + 0.5) * w / camera.width).long()
    return depth[rows][:, columns]


def _of_npz(path: Path) -> NDArray[np.float64]:
    at = read_npz(path)
    points = maybe(at, "points")
    found = next((v for n in NAMES if (v := maybe(at, n)) is not None), None)
    if found is None and points is not None and np.ndim(points.value) == 3:
        return np.asarray(points.value, dtype=np.float64)[..., 2]
    if found is None:
        refuse(at, f"one of the arrays {', '.join(NAMES)} or points", f"{', '.join(at.value)}")
    return _two_axes(found)


def _two_axes(at: At) -> NDArray[np.float64]:
    value = np.asarray(at.value)
    while value.ndim > 2 and 1 in (value.shape[0], value.shape[-1]):
        value = value[0] if value.shape[0] == 1 else value[..., 0]
    if value.dtype.kind == "f":  # unknown pixels may be NaN or infinite
        value = np.where(np.isfinite(value), value, 0)
    return array(At(value, at.file, at.field), ("h", "w")).astype(np.float64)


def _of_png(path: Path) -> NDArray[np.float64]:
    with opened_picture(path, "a depth map") as picture:
        mode, values = picture.mode, np.asarray(picture)
    if not mode.startswith("I"):
        raise InputError(
            f"{path.name}: has {mode} pixels, expected 16 bits of millimetres (8 bits or colours "
            "have no unit)"
        )
    return values.astype(np.float64) / MILLIMETRES


def median_depths(
    depth: Float[Tensor, "h w"] | None, masks: Bool[Tensor, "things h w"]
) -> Float[Tensor, " things"]:
    """Median over each mask [m]; NaN where nothing is known."""
    if depth is None:
        return torch.full((len(masks),), torch.nan)
    rows = [depth[mask & depth.isfinite()] for mask in masks]
    return torch.stack([row.median() if len(row) else depth.new_tensor(torch.nan) for row in rows])


def range_in(
    depth: Float[Tensor, "h w"], cues: ImageCues, camera: Camera, slack: float
) -> DepthRange:
    """Bounds on the front surfaces within the masks: the measured depth and its error.

    Args:
        depth: Measured [m]; NaN: unknown.
        cues: The windows.
        camera: Of the picture.
        slack: Error of the depth [share].
    """
    count = len(cues.boxes)
    images = sample_nearest(depth.nan_to_num(0.0), cues.views, camera.K, 0.0)
    known = (images > 0) & (cues.masks > 0.5)
    infinity = torch.full_like(images, torch.inf)
    near = torch.where(known, images * (1 - slack), -infinity)
    far = torch.where(known, images * (1 + slack), infinity)
    return DepthRange(near, far, -infinity, torch.ones(count))


def floor_height(
    depth: Float[Tensor, "h w"], camera: Camera, things: Bool[Tensor, "h w"]
) -> float | None:
    """Height of the camera above the lowest level surface of the picture [m]; None: there is none.

    Args:
        depth: Measured [m].
        camera: With its tilt.
        things: Where furniture and people are; they are left out.
    """
    step = max(1, camera.width // 320)
    rows, columns = torch.arange(0, camera.height, step), torch.arange(0, camera.width, step)
    z = depth[rows][:, columns].double()
    y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1).double()
    points = to_world(
        z[..., None] * (rays @ torch.linalg.inv(camera.K.double()).mT), camera.R_cam_world.double()
    )
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = torch.linalg.cross(down, across)
    level = normal[..., 1].abs() / normal.norm(dim=-1).clamp_min(1e-9) > LEVEL
    free = ~things[rows][:, columns][1:-1, 1:-1]
    heights = points[1:-1, 1:-1, 1][level & free & points[1:-1, 1:-1, 1].isfinite()]
    heights = heights[heights < 0]
    if len(heights) < 50:
        return None
    slices = ((heights - heights.min()) / CELL).long()
    counts = torch.bincount(slices)
    full = int((counts >= ENOUGH * counts.max()).nonzero()[0])
    near = (slices - full).abs() <= 1
    return -float(heights[near].median())
