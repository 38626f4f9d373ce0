"""Windows of fewer pixels: what is far off is found there, at a fraction of the work."""

from dataclasses import replace

from torch import Tensor

from mover.energy.human_terms import DepthRange
from mover.energy.image_terms import Borders
from mover.energy.objective import HumanCues, ImageCues
from mover.geometry.raster import Crops


def coarser_image(image: ImageCues, factor: int) -> ImageCues:
    """The same with `factor` times fewer pixels along each side.

    Raises:
        ValueError: If the windows are not a multiple of it.
    """
    views = image.views
    if factor < 1 or views.height % factor or views.width % factor:
        raise ValueError(
            f"coarser_image: windows of {views.height} x {views.width}, which {factor} does not"
            " divide"
        )
    if factor == 1:
        return image
    zoom = views.K.new_tensor([1 / factor, 1 / factor, 1.0])[:, None]
    small = Crops(views.K * zoom, views.height // factor, views.width // factor)
    masks = _tiles(image.masks, factor).mean((-3, -1))
    keep = _tiles(image.keep, factor).all(-1).all(-2)
    borders = image.borders
    if borders is not None:
        borders = Borders(borders.shifts, _tiles(borders.masks, factor).mean((-3, -1)))
    measured = image.measured
    if measured is not None:
        measured = replace(measured, depth=_middles(measured.depth, factor))
    return replace(
        image, views=small, masks=masks, keep=keep, borders=borders, measured=measured,
    )  # fmt: skip


def coarser_humans(humans: HumanCues, factor: int) -> HumanCues:
    """The same with the bounds of the depth at one pixel of each tile."""
    if factor == 1 or humans.depth is None:
        return humans
    near, far = (_middles(bound, factor) for bound in (humans.depth.near, humans.depth.far))
    depth = DepthRange(near, far, humans.depth.area * factor**2)
    return replace(humans, depth=depth)


def _middles(image: Tensor, factor: int) -> Tensor:
    """One pixel of each tile: bounds and depths have no mean."""
    middle = factor // 2
    return image[..., middle::factor, middle::factor]


def _tiles(image: Tensor, factor: int) -> Tensor:
    return image.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor))
