r"""Outlines of masks are too wide or too narrow by about the same all round (not in the paper).

Price:     min_\delta  \lambda_1 L_bbox(\delta) + \lambda_2 (L_occ-sil(\delta) + \rho \delta^2)
           where mask and box of the object are grown by \delta pixels of the image
Robust:    \delta among some shifts, for each object and start on its own; \rho = 0.0005.

A segmenter that draws every outline a pixel too wide moves a shelf whose base is hidden, and makes
the legs of a chair twice as thick: the place at which that costs least is not
the true one. What all borders of an object have in common says nothing about where it stands.
"""

from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.terms.bbox import bbox_term
from mover.energy.terms.silhouette import silhouette_term

PRICE = 0.0005  # [1/px^2]


@record
class Borders:
    """The masks as they are where their outlines are drawn too narrow or too wide."""

    shifts: Float[Tensor, " shifts"]
    """By how much the true outline lies outside the detected one [px of the image]."""
    masks: Float[Tensor, "shifts objects h w"]
    """Coverage of the window's pixels by what is really there."""

    @cached_property
    def steps(self) -> tuple[float, ...]:
        """The shifts as numbers."""
        return tuple(self.shifts.tolist())


class Fitted(NamedTuple):
    """The terms of the image with the shift at which they are least."""

    bbox: Float[Tensor, "*starts objects"]
    silhouette: Float[Tensor, "*starts objects"]
    shift: Int[Tensor, "*starts objects"]
    """Its number."""


def borders_of(
    masks: Float[Tensor, "objects h w"], zoom: Float[Tensor, " objects"], shifts: tuple[float, ...]
) -> Borders:
    """The masks grown by each shift, with borders as wide as a pixel.

    Args:
        masks: Detected coverage.
        zoom: Pixels of the window for one of the image.
        shifts: [px of the image], below zero: taken in.
    """
    from scipy.ndimage import distance_transform_edt

    def inside(mask: Tensor) -> Tensor:
        within = (mask > 0.5).cpu().numpy()
        if not within.any():
            return torch.full_like(mask, -torch.inf)
        near, beyond = (distance_transform_edt(x) for x in (within, ~within))
        far = (torch.as_tensor(near) - torch.as_tensor(beyond)).to(mask)
        return torch.where(far.abs() < 1.5, mask - 0.5, far - 0.5 * far.sign())

    depth = torch.stack([inside(m) for m in masks]) if len(masks) else masks
    grown = [
        masks if shift == 0 else (0.5 + depth + (shift * zoom)[:, None, None]).clamp(0, 1)
        for shift in shifts
    ]
    return Borders(masks.new_tensor(shifts), torch.stack(grown))


def fit_borders(
    drawn: tuple[Float[Tensor, "*starts objects h w"], Float[Tensor, "*starts objects verts 2"]],
    seen: tuple[Float[Tensor, "objects 4"], Int[Tensor, "objects 4"], Bool[Tensor, "objects h w"]],
    trust: Float[Tensor, " objects"],
    borders: Borders,
    weights: tuple[float, float],
) -> Fitted:
    """Price box and silhouette with the shift of the border that suits each best.

    Args:
        drawn: Silhouettes, and vertices in the image [px].
        seen: Detected boxes [px], what is known of their sides, and which pixels are.
        trust: Weight of each silhouette.
        borders: What the masks may be.
        weights: Of the box and of the silhouette.
    """
    boxes, sides, keep = seen
    bbox, outline = [], []
    for shift, mask in zip(borders.steps, borders.masks, strict=True):
        bbox.append(bbox_term(drawn[1], boxes, sides, 1.0, "robust", shift))
        outline.append(trust * silhouette_term(drawn[0], mask, keep, "robust"))
    boxed, price = torch.stack(bbox), PRICE * borders.shifts.square()
    silhouette = torch.stack(outline)
    price = price.view(-1, *[1] * (silhouette.dim() - 1)).expand_as(silhouette)
    best = (weights[0] * boxed + weights[1] * (silhouette + price)).detach().argmin(0)
    index = best.unsqueeze(0)
    chosen = [x.gather(0, index)[0] for x in (boxed, silhouette, price)]
    return Fitted(chosen[0], chosen[1] + chosen[2], best)
