r"""Objects fill their detected 2D boxes (supplement, "Loss Terms").

Price:     L_bbox = \sum_i \| Proj_i^a - Det_i^a \|,  a in {x_min, y_min, width}
Paper:     Proj_i is the projected 3D box (its eight corners); an l1 norm, in pixels of an image
           that is 640 wide.
Robust:    extent of the mesh, all four sides, each divided by the box's size \sqrt{w h}, so that
           near and far objects count alike. Where the image's border or something in front may hide
           more of the object, it reaches at least as far as it is seen, and may reach farther:
           beyond the border at no price, behind something at a bounded one, since beside many
           sides something stands that hides nothing of it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.energy.config import Variant

WIDTH = 640.0  # [px], the image width at which the weights of the paper have their meaning
UNKNOWN, SEEN, LEAST, LIKELY = range(4)
"""What is known of a side: nothing, where it is, how far the object reaches at least, or where it
is unless something in front hides more."""
SOFT = 0.01  # of a box's size: half width of the rounded tip of the robust price
HIDDEN = 0.05  # the most that an object pays for reaching beyond a side that may be hidden


def bbox_term(
    pixels: Float[Tensor, "*starts objects points 2"],
    detected: Float[Tensor, "objects 4"],
    sides: Int[Tensor, "objects 4"],
    width: float,
    form: Variant,
    wider: float = 0.0,
) -> Float[Tensor, "*starts objects"]:
    """Distance between projected and detected boxes.

    Args:
        pixels: Projected corners (`paper`) or vertices [px].
        detected: x_min, y_min, x_max, y_max [px].
        sides: `UNKNOWN`, `SEEN`, `LEAST` or `LIKELY`; an object without a box costs nothing.
        width: Width of the image [px].
        form: How it is priced; [px at 640] for `paper`, else box sizes.
        wider: How far the true sides lie outside the detected ones [px] (`robust` only).
    """
    drawn = torch.cat([pixels.amin(-2), pixels.amax(-2)], -1)
    if form == "robust":
        size = (detected[:, 2:] - detected[:, :2]).clamp_min(1).prod(-1, keepdim=True).sqrt()
        outward = constant((-1.0, -1.0, 1.0, 1.0), detected)
        off = (drawn - (detected + wider * outward)) / size
        price = (off.square() + SOFT**2).sqrt() - SOFT
        beyond = (sides == LIKELY) & (off * outward > 0)
        price = torch.where(beyond, HIDDEN * price / (HIDDEN + price), price)
        free = (sides == UNKNOWN) | ((sides == LEAST) & (off * outward > 0))
        return (price * ~free).sum(-1)
    off = (_corner_and_width(drawn) - _corner_and_width(detected)).abs() * (WIDTH / width)
    return off.sum(-1) * sides.any(-1)


def _corner_and_width(box: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3"]:
    return torch.cat([box[..., :2], box[..., 2:3] - box[..., :1]], -1)
