"""Masks whose border has been found: evidence without that freedom."""

from dataclasses import replace

import torch

from ..energy import ImageCues, SceneWeights, best_borders
from ..types import Camera, Layout, Objects


def fixed_borders(
    image: ImageCues, layout: Layout, objects: Objects, camera: Camera, weights: SceneWeights
) -> ImageCues:
    """The masks and boxes under the shift that suits a layout best (`terms.border`).

    The layout has one place for each object.
    """
    borders = image.borders
    if borders is None:
        return image
    with torch.no_grad():
        number = best_borders(layout, objects, camera, image, weights)
    shift = borders.shifts[number]
    boxes = image.boxes + torch.stack([-shift, -shift, shift, shift], -1)
    masks = borders.masks[number, torch.arange(len(number))]
    return replace(image, masks=masks, boxes=boxes, borders=None)
