"""Bitmaps inside the page: the image, and the furniture over it before and after."""

import base64
import io

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from .report_overlay import backdrop, draw_overlay
from .types import Scene

QUALITY = 87  # of a JPEG


def draw_comparison(
    image: Float[Tensor, "h w 3"] | None, initial: Scene, result: Scene, widest: int
) -> str:
    """Two overlays on top of each other, with a bar between them that can be dragged.

    Args:
        image: The picture behind both; None: a neutral backdrop.
        initial: Left of the bar.
        result: Right of it.
        widest: Width of the pictures at most [px].
    """
    before, after = (data_url(draw_overlay(canvas(image, s, widest), s)) for s in (initial, result))
    return (
        '<figure class="compare">'
        f'<img src="{after}" alt="The furniture after the run, over the image">'
        f'<img class="over" src="{before}" alt="The furniture before the run, over the image">'
        '<span class="tag before">Before</span><span class="tag after">After</span>'
        '<span class="edge"></span><input type="range" min="0" max="100" step="1" value="50" '
        'aria-label="Share of the picture that shows the furniture before the run"></figure>'
    )


def canvas(
    image: Float[Tensor, "h w 3"] | None, scene: Scene, widest: int
) -> Float[Tensor, "height width 3"]:
    """What the furniture is drawn on, at most `widest` pixels wide: the image or a backdrop."""
    if image is not None:
        return shrink(image, widest)
    width = min(widest, scene.camera.width)
    return backdrop(max(1, round(width * scene.camera.height / scene.camera.width)), width)


def shrink(image: Float[Tensor, "h w 3"], widest: int) -> Float[Tensor, "height width 3"]:
    """The image at most `widest` pixels wide."""
    if image.shape[1] <= widest:
        return image.detach().cpu().float()
    size = (widest, max(1, round(widest * image.shape[0] / image.shape[1])))
    small = bitmap(image).resize(size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(small).copy()).float() / 255


def data_url(image: Float[Tensor, "h w 3"]) -> str:
    """The image as a JPEG that stands in the page itself."""
    file = io.BytesIO()
    bitmap(image).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def bitmap(image: Float[Tensor, "h w 3"]) -> Image.Image:
    """The image with 8 bits a channel."""
    return Image.fromarray((image.detach().cpu().clamp(0, 1) * 255).round().byte().numpy())
