"""What metric depth of the picture says of objects and the floor."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.types import Camera
from mover.energy.human_terms import DepthRange
from mover.energy.objective import ImageCues
from mover.geometry.camera import to_world
from mover.geometry.crops import sample_nearest

LEVEL = 0.92  # cosine of the largest tilt of a surface that counts as floor
CELL = 0.04  # [m], height of a slice in which floor is counted
ENOUGH = 0.25  # of the fullest slice: the lowest slice with so much is the floor


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
    """Bounds on the front surfaces in the masks: measured depth [m; NaN: unknown], -+ `slack`."""
    count = len(cues.boxes)
    images = sample_nearest(depth.nan_to_num(0.0), cues.views, camera.K, 0.0)
    known = (images > 0) & (cues.masks > 0.5)
    infinity = torch.full_like(images, torch.inf)
    near = torch.where(known, images * (1 - slack), -infinity)
    far = torch.where(known, images * (1 + slack), infinity)
    return DepthRange(near, far, torch.ones(count))


def floor_height(
    depth: Float[Tensor, "h w"], camera: Camera, things: Bool[Tensor, "h w"]
) -> float | None:
    """Height of the camera above the lowest level surface of the picture [m]; None: there is none.

    Furniture and people (`things`) are left out.
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
