"""Windows of fewer pixels: what is far off is found there, at a fraction of the work."""

from dataclasses import replace

from torch import Tensor

from ..energy import HumanCues, ImageCues
from ..geometry.raster import Views
from ..terms.border import Borders
from ..terms.depth import DepthRange
from ..terms.silhouette import outline_root


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
    small = Views(views.K * zoom, views.height // factor, views.width // factor)
    masks = _tiles(image.masks, factor).mean((-3, -1))
    keep = _tiles(image.keep, factor).all(-1).all(-2)
    outline = None if image.outline is None else outline_root(masks)
    borders = image.borders
    if borders is not None:
        borders = Borders(borders.shifts, _tiles(borders.masks, factor).mean((-3, -1)))
    return replace(image, views=small, masks=masks, keep=keep, outline=outline, borders=borders)


def coarser_humans(humans: HumanCues, factor: int) -> HumanCues:
    """The same with the bounds of the depth at one pixel of each tile."""
    if factor == 1 or humans.depth is None:
        return humans
    middle = factor // 2
    near, far, free = (
        getattr(humans.depth, k)[..., middle::factor, middle::factor]
        for k in ("near", "far", "free")
    )
    depth = DepthRange(near, far, free, humans.depth.area * factor**2)
    return replace(humans, depth=depth)


def _tiles(image: Tensor, factor: int) -> Tensor:
    return image.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor))
