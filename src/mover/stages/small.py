"""The image at the width at which the paper's weights have their meaning."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.raster import Views
from ..terms.bbox import WIDTH
from ..types import Camera


def small_views(camera: Camera) -> Views:
    """The whole image as one window, at most 640 pixels wide."""
    zoom = min(1.0, WIDTH / camera.width)
    width, height = max(1, round(camera.width * zoom)), max(1, round(camera.height * zoom))
    zooms = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.K)
    return Views((camera.K * zooms.unsqueeze(-1)).unsqueeze(0), height, width)


def small_camera(camera: Camera) -> Camera:
    """The camera of that image."""
    views = small_views(camera)
    return replace(camera, K=views.K[0], width=views.width, height=views.height)


def small_masks(masks: Bool[Tensor, "rows h w"], camera: Camera) -> Bool[Tensor, "rows sh sw"]:
    """Masks of that image, by their nearest pixel; those given, where they have its size."""
    views, (height, width) = small_views(camera), masks.shape[-2:]
    if (views.height, views.width) == (height, width):
        return masks
    rows = ((torch.arange(views.height) + 0.5) * height / views.height).long()
    columns = ((torch.arange(views.width) + 0.5) * width / views.width).long()
    return masks[:, rows][:, :, columns]


def small_boxes(boxes: Float[Tensor, "rows 4"], camera: Camera) -> Float[Tensor, "rows 4"]:
    """Boxes in that image [px]."""
    views = small_views(camera)
    zoom = [views.width / camera.width, views.height / camera.height]
    return boxes * boxes.new_tensor(zoom * 2)
