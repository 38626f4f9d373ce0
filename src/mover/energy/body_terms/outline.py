r"""The outline of a body lies on the outline of its mask.

Not in the paper, whose refinement of bodies knows keypoints only.

Evidence:  points of the drawn body's outline where nothing else can end the person's mask; for each
           the skin next to it, the outline's normal, and how far the mask's outline is from it.
Price:     Geman-McClure of that distance along the normal, in usual errors of masks; the points of
           one body share a weight. A mask that is too wide all around says nothing: that much is
           taken out of the distances.
"""

from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.minimize import geman_mcclure
from mover.geometry.camera import project

BORDER = 0.0025  # [image widths], usual error of a mask's outline that is not the same all around
TAIL = 3.0  # usual errors at which the price is half of the most
POINTS = 16.0  # independent places of an outline


@record
class Outline:
    """Where the outlines of bodies should go, seen from where they are."""

    body: Int[Tensor, " points"]
    skin: Int[Tensor, " points"]
    """Index of the skin point that carries the outline."""
    pixel: Float[Tensor, "points 2"]
    """Where that skin point is seen now [px]."""
    normal: Float[Tensor, "points 2"]
    """Of the outline in the image, outwards."""
    gap: Float[Tensor, " points"]
    """How far the outline is outside its mask [px]; negative: inside."""
    weight: Float[Tensor, " points"]
    """Share in the body's weight, at most `POINTS` in sum."""


def outline_term(
    skin_cam: Float[Tensor, "bodies points 3"],
    outline: Outline,
    K: Float[Tensor, "3 3"],
    width: int,
) -> Float[Tensor, " bodies"]:
    """Price of outlines (of skin in camera axes) that leave the outlines of the masks [nats]."""
    here = project(skin_cam[outline.body, outline.skin], K)
    off = ((here - outline.pixel) * outline.normal).sum(-1) + outline.gap
    price = 0.5 * TAIL**2 * outline.weight * geman_mcclure(off / (BORDER * width), TAIL)
    return skin_cam.new_zeros(len(skin_cam)).index_add(0, outline.body, price)
