r"""Objects cover their masks, wherever nothing may hide them (Sec. 3.1, after PHOSA).

Price:     L_occ-sil = \sum_i \sum_q keep_i(q) (Sil_i(q) - M_i(q))^2
Evidence:  M_i, the mask in a square window around the object's box; keep_i is 0 where another
           object, or a person, may hide this one, and beyond the border of the image.
Paper:     the sum over a window of 256 x 256 pixels.
Robust:    divided by the number of mask pixels, so that resolution and size carry no weight.

The gradient is exact (rendering, docs/method.md), hence 10-14 times smaller than that of the
neural renderer that the authors used; their weight is kept as printed.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from mover.energy.config import Variant


def silhouette_term(
    drawn: Float[Tensor, "*starts objects h w"],
    mask: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
    form: Variant,
) -> Float[Tensor, "*starts objects"]:
    """Squared difference between drawn and detected masks [px], or per mask pixel (`robust`)."""
    price = squares(drawn, mask, keep)
    if form == "robust":
        return price / (mask * keep).sum((-2, -1)).clamp_min(1)
    return price


def squares(
    drawn: Float[Tensor, "*starts objects h w"],
    mask: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
) -> Float[Tensor, "*starts objects"]:
    """Sum of the kept squared differences; differentiable once, in what is drawn."""
    price = _Squares.apply(drawn, mask, keep)
    assert isinstance(price, Tensor)
    return price


class _Squares(torch.autograd.Function):
    """Keeps the differences."""

    @staticmethod
    def forward(ctx: Any, drawn: Tensor, mask: Tensor, keep: Tensor) -> Tensor:  # noqa: ANN401
        gap = torch.where(keep, drawn - mask, 0.0)
        ctx.save_for_backward(gap)
        flat = gap.flatten(-2)
        return (flat.unsqueeze(-2) @ flat.unsqueeze(-1))[..., 0, 0]

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None, None]:
        (gap,) = ctx.saved_tensors
        return gap * (2 * grads[0][..., None, None]), None, None
