r"""Terms of Eq. 1 that the image says: boxes, silhouettes, borders of masks, measured depth.

    Boxes        L_bbox    = \sum_i \| Proj_i^a - Det_i^a \|,  a in {x_min, y_min, width}
    Silhouettes  L_occ-sil = \sum_i \sum_q keep_i(q) (Sil_i(q) - M_i(q))^2
    Borders      \min_\delta \lambda_1 L_bbox(\delta)
                              + \lambda_2 (L_occ-sil(\delta) + \rho \delta^2)
    Depth map    L_measured = \sum_i mean_{p in Sil_i, M_i} 2 \log(1 + \delta^2 / 3 \sigma^2)

The first two are of the supplement ("Loss Terms") and Sec. 3.1 (after PHOSA), the others are not in
the paper. `paper` has the printed form with its `Readings`, `robust` a normalised one.
"""

from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.core.records import record
from mover.energy.config import Variant
from mover.geometry.crops import depth_in
from mover.geometry.raster import Depths

# --- Boxes -------------------------------------------------------------------------------------

WIDTH = 640.0  # [px], the image width at which the weights of the paper have their meaning
UNKNOWN, SEEN, LEAST, LIKELY = range(4)
"""What is known of a side: nothing, where it is, how far the object reaches at least, or where it
is unless something in front hides more."""
SOFT = 0.01  # of a box's size: half width of the rounded tip of the robust cost
HIDDEN = 0.05  # the highest cost of reaching beyond a side that may be hidden


def bbox_term(
    pixels: Float[Tensor, "*starts objects points 2"],
    detected: Float[Tensor, "objects 4"],
    sides: Int[Tensor, "objects 4"],
    width: float,
    form: Variant,
    wider: float = 0.0,
) -> Float[Tensor, "*starts objects"]:
    r"""Distance between projected and detected boxes [px at 640], or in box sizes (`robust`).

    Paper: the eight corners of the 3D box, an l1 norm of x_min, y_min and width. Robust: all four
    sides of the mesh's extent, each divided by the box's size \sqrt{w h}, so that near and far
    objects count the same. Where the border of the image or something in front may hide more of the
    object, it reaches at least as far as it is seen, and may reach farther: beyond the border free
    of cost, behind something at a bounded cost.

    `pixels` are projected corners (`paper`) or vertices, `detected` x_min, y_min, x_max, y_max, of
    an image `width` wide; the true sides lie farther out by `wider` (`robust` only) [px]. `sides`
    has `UNKNOWN`, `SEEN`, `LEAST` or `LIKELY`; an object without a box costs nothing.
    """
    drawn = torch.cat([pixels.amin(-2), pixels.amax(-2)], -1)
    if form == "robust":
        size = (detected[:, 2:] - detected[:, :2]).clamp_min(1).prod(-1, keepdim=True).sqrt()
        outward = constant((-1.0, -1.0, 1.0, 1.0), detected)
        off = (drawn - (detected + wider * outward)) / size
        cost = (off.square() + SOFT**2).sqrt() - SOFT
        beyond = (sides == LIKELY) & (off * outward > 0)
        cost = torch.where(beyond, HIDDEN * cost / (HIDDEN + cost), cost)
        free = (sides == UNKNOWN) | ((sides == LEAST) & (off * outward > 0))
        return (cost * ~free).sum(-1)
    drawn, detected = (
        torch.cat([box[..., :2], box[..., 2:3] - box[..., :1]], -1) for box in (drawn, detected)
    )
    return ((drawn - detected).abs() * (WIDTH / width)).sum(-1) * sides.any(-1)


# --- Silhouettes that account for occlusion ----------------------------------------------------

RENDERER = 12.0  # gradient of the authors' neural renderer over the exact one: 10 to 14, measured


def silhouette_term(
    drawn: Float[Tensor, "*starts objects h w"],
    mask: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
    form: Variant,
) -> Float[Tensor, "*starts objects"]:
    """Squared difference between drawn and detected masks [px], or per mask pixel (`robust`).

    `mask` is that in a square window around the object's box; `keep` is False where another
    object, or a person, may hide this one, and beyond the border of the image. The gradient is
    exact (`robust`), or as steep as that of the renderer for which the weight was printed.
    """
    gap = torch.where(keep, drawn - mask, 0.0).flatten(-2)
    cost = (gap.unsqueeze(-2) @ gap.unsqueeze(-1))[..., 0, 0]
    if form == "robust":
        return cost / (mask * keep).sum((-2, -1)).clamp_min(1)
    return cost + (RENDERER - 1) * (cost - cost.detach())


# --- Borders: outlines of masks are too wide or too narrow by about the same all round -----------
#
# A segmenter that draws every outline a pixel too wide moves a shelf whose base is hidden. What all
# borders of an object have in common says nothing about where it stands.

BORDER_WEIGHT = 0.0005  # rho [1/px^2]


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


class BestShift(NamedTuple):
    """The terms of the image with the shift at which they are least."""

    bbox: Float[Tensor, "*starts objects"]
    silhouette: Float[Tensor, "*starts objects"]
    shift: Int[Tensor, "*starts objects"]  #: its number


def borders_of(
    masks: Float[Tensor, "objects h w"], zoom: Float[Tensor, " objects"], shifts: tuple[float, ...]
) -> Borders:
    """The masks grown by each shift [px of the image; below zero: taken in], borders a pixel wide.

    `zoom` is the number of pixels of the window for one of the image.
    """

    def inside(mask: Tensor) -> Tensor:
        within = (mask > 0.5).cpu().numpy()
        if not within.any():
            return torch.full_like(mask, -torch.inf)
        far = torch.as_tensor(depth_in(within) - depth_in(~within)).to(mask)
        return torch.where(far.abs() < 1.5, mask - 0.5, far - 0.5 * far.sign())

    depth = torch.stack([inside(m) for m in masks]) if len(masks) else masks
    grown = [
        masks if shift == 0 else (0.5 + depth + (shift * zoom)[:, None, None]).clamp(0, 1)
        for shift in shifts
    ]
    return Borders(masks.new_tensor(shifts), torch.stack(grown))


def fit_borders(
    drawn: Float[Tensor, "*starts objects h w"],
    pixels: Float[Tensor, "*starts objects verts 2"],
    boxes: Float[Tensor, "objects 4"],
    sides: Int[Tensor, "objects 4"],
    keep: Bool[Tensor, "objects h w"],
    trust: Float[Tensor, " objects"],
    borders: Borders,
    weights: tuple[float, float],
) -> BestShift:
    """Box and silhouette (robust) with the shift of the border that suits each object best."""
    bbox, outline = [], []
    for shift, mask in zip(borders.steps, borders.masks, strict=True):
        bbox.append(bbox_term(pixels, boxes, sides, 1.0, "robust", shift))
        outline.append(trust * silhouette_term(drawn, mask, keep, "robust"))
    boxed, cost = torch.stack(bbox), BORDER_WEIGHT * borders.shifts.square()
    silhouette = torch.stack(outline)
    cost = cost.view(-1, *[1] * (silhouette.dim() - 1)).expand_as(silhouette)
    best = (weights[0] * boxed + weights[1] * (silhouette + cost)).detach().argmin(0)
    index = best.unsqueeze(0)
    chosen = [x.gather(0, index)[0] for x in (boxed, silhouette, cost)]
    return BestShift(chosen[0], chosen[1] + chosen[2], best)


# --- Measured depth: front surfaces lie where a depth network sees them --------------------------

FEWEST = 100.0  # pixels by which a sum is divided at least
NEAREST = 0.05  # [m], nothing is nearer


@record
class Measured:
    """The measured depth in the windows of the objects, after its scale was fitted to the room."""

    depth: Float[Tensor, "objects h w"]  #: [m]; 0 where it is not known
    spread: Float[Tensor, " objects"]  #: how far it is off: standard deviation of its logarithm


def measured_term(
    seen: Depths, mask: Float[Tensor, "objects h w"], known: Measured
) -> Float[Tensor, "*starts objects"]:
    """Distance of drawn from measured surfaces, a Student t of their logarithms [nats].

    Errors of a network are smooth: the pixels of one object are off together. So it is their mean:
    an object has one measurement, however large it is in the image.
    """
    there = seen.covered & (mask > 0.5) & (known.depth > 0)
    drawn, measured = (x.clamp_min(NEAREST).log() for x in (seen.nearest, known.depth))
    off = (drawn - measured) / known.spread[:, None, None]
    cost = 2 * (1 + off.square() / 3).log()
    return (cost * there).sum((-2, -1)) / there.sum((-2, -1)).clamp_min(FEWEST)
