"""Square windows of an image, exact means of image areas in them, distances in masks."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.geometry.camera import at_pixels
from mover.geometry.raster import Crops


def crop_views(
    K: Float[Tensor, "3 3"], boxes: Float[Tensor, "items 4"], margin: float, size: int
) -> Crops:
    """A square window, `size` pixels wide, around each box x_min, y_min, x_max, y_max [px].

    It is larger by the share `margin` than the larger side of its box.
    """
    center = (boxes[:, :2] + boxes[:, 2:]) / 2
    side = (boxes[:, 2:] - boxes[:, :2]).amax(-1).clamp_min(2) * (1 + margin)
    zoom = size / side
    crop = K.expand(len(boxes), 3, 3).clone()
    crop[:, :2, 2] -= center - side.unsqueeze(-1) / 2
    crop[:, :2] *= zoom[:, None, None]
    return Crops(crop, size, size)


def grid_in_image(views: Crops, K: Float[Tensor, "3 3"]) -> tuple[Tensor, Tensor]:
    """Image coordinates [px] of the lines between window pixels: x (items, w+1), y (items, h+1)."""
    zoom = views.K[:, 0, 0] / K[0, 0]
    corner = K[:2, 2] - views.K[:, :2, 2] / zoom.unsqueeze(-1)
    x = corner[:, :1] + torch.arange(views.width + 1) / zoom.unsqueeze(-1)
    y = corner[:, 1:] + torch.arange(views.height + 1) / zoom.unsqueeze(-1)
    return x, y


def area_mean(
    images: Float[Tensor, "items h w"], views: Crops, K: Float[Tensor, "3 3"]
) -> Float[Tensor, "items wh ww"]:
    """Exact mean of each image over each pixel of its window; zero outside the image."""
    height, width = images.shape[-2:]
    total = torch.nn.functional.pad(images.double().cumsum(-1).cumsum(-2), (1, 0, 1, 0))
    x, y = grid_in_image(views, K)
    rows = _between(total, y.double().clamp(0, height))
    sums = _between(rows.mT, x.double().clamp(0, width)).mT
    area = (x[:, 1:] - x[:, :-1]).unsqueeze(-2) * (y[:, 1:] - y[:, :-1]).unsqueeze(-1)
    return (sums.diff(dim=-1).diff(dim=-2) / area).to(images).clamp(0, 1)


def _between(
    table: Float[Tensor, "items rows columns"], at: Float[Tensor, "items lines"]
) -> Float[Tensor, "items lines columns"]:
    """Rows of a table at fractional places, interpolated."""
    low = at.floor().long().clamp(0, table.shape[-2] - 2)
    share = (at - low).unsqueeze(-1)
    index = low.unsqueeze(-1).expand(-1, -1, table.shape[-1])
    return table.gather(-2, index) * (1 - share) + table.gather(-2, index + 1) * share


def sample_nearest(
    image: Float[Tensor, "h w"], views: Crops, K: Float[Tensor, "3 3"], outside: float
) -> Float[Tensor, "items wh ww"]:
    """Value of an image with intrinsics `K` at the centre of each window pixel."""
    x, y = grid_in_image(views, K)
    columns, rows = (((line[:, 1:] + line[:, :-1]) / 2).floor().long() for line in (x, y))
    pixels = torch.stack(torch.broadcast_tensors(columns[:, None], rows[:, :, None]), -1)
    picked, inside = at_pixels(image, pixels)
    return torch.where(inside, picked, torch.full_like(picked, outside))


def depth_in(mask: np.ndarray) -> np.ndarray:
    """Distance of each pixel of a mask from the nearest one outside of it; 0 there [px].

    To the same bits each time: squares are whole numbers, OpenCV's last bits depend on where the
    picture lies in memory.
    """
    import cv2

    found = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    np.square(found, out=found)
    return np.sqrt(np.rint(found, out=found), out=found)
