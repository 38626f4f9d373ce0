"""Square windows of an image, exact means of image areas in them, distances in masks."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
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


Region = tuple[slice, slice]  #: rows and columns of an image


def regions(
    center: Float[Tensor, "items 2"], reach: Float[Tensor, " items"], size: tuple[int, int]
) -> list[Region]:
    """What squares need of an image of this `size` (h, w): two rows and columns at least."""
    most = torch.tensor(size[::-1])
    low = (center - reach[:, None]).floor().long().clamp_min(0).minimum(most - 2)
    high = (center + reach[:, None]).ceil().long().minimum(most).maximum(low + 2)
    ends = zip(low.tolist(), high.tolist(), strict=True)
    return [(slice(y, bottom), slice(x, right)) for (x, y), (right, bottom) in ends]


def area_mean(
    images: Sequence[Bool[Tensor, "rows columns"]],
    at: Sequence[Region],
    views: Crops,
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "items wh ww"]:
    """Exact mean of each mask over each pixel of its window; zero outside the image.

    Of each mask there is the region that the window needs.
    """
    x, y = grid_in_image(views, K)
    found: list[Tensor] = []
    for image, (rows, columns), across, down in zip(images, at, x, y, strict=True):
        total = image.double().cumsum(-1).cumsum(-2)
        total = torch.nn.functional.pad(total, (1, 0, 1, 0))
        lines = _between(total, (down.double() - rows.start).clamp(0, image.shape[0]))
        sums = _between(lines.mT, (across.double() - columns.start).clamp(0, image.shape[1])).mT
        area = across.diff() * down.diff().unsqueeze(-1)
        found.append((sums.diff(dim=-1).diff(dim=-2) / area).float().clamp(0, 1))
    return torch.stack(found) if found else views.K.new_zeros(0, views.height, views.width)


def share_inside(
    views: Crops, K: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "items wh ww"]:
    """Share of each pixel of the windows that lies in an image of this `size` (h, w)."""
    x, y = grid_in_image(views, K)
    across, down = ((line.clamp(0, most).diff() / line.diff())
                    for line, most in ((x, size[1]), (y, size[0])))  # fmt: skip
    return across.unsqueeze(-2) * down.unsqueeze(-1)


def _between(
    table: Float[Tensor, "rows columns"], at: Float[Tensor, " lines"]
) -> Float[Tensor, "lines columns"]:
    """Rows of a table at fractional places, interpolated."""
    low = at.floor().long().clamp(0, len(table) - 2)
    share = (at - low).unsqueeze(-1)
    return table[low] * (1 - share) + table[low + 1] * share


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
