r"""Objects cover their masks, wherever nothing may hide them (Sec. 3.1, after PHOSA).

Price:     L_occ-sil = \sum_i \sum_q keep_i(q) (Sil_i(q) - M_i(q))^2
Evidence:  M_i, the mask in a square window around the object's box; keep_i is 0 where another
           object, or a person, may hide this one, and beyond the border of the image.
Paper:     the sum over a window of 256 x 256 pixels.
Release:   the same, with an edge term of its own weight (`edge_term`) and with everything beyond
           the border counted as background.
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

RING = 7  # [px], PHOSA's window for the ring around a silhouette


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


def edge_term(
    drawn: Float[Tensor, "*starts objects h w"],
    mask: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
    outline: Float[Tensor, "objects h w"] | None = None,
) -> Float[Tensor, "*starts objects"]:
    """One-way distance of the drawn outline from the detected one (PHOSA) [px^1.5].

    Half the sum of the outer ring of the kept silhouette times the root of the distance to the
    ring of the mask. Only the `release` preset gives it a weight.

    Args:
        drawn: Silhouettes.
        mask: Detected coverage.
        keep: What is outside counts as empty.
        outline: `outline_root` of the mask; None: it is found anew.
    """
    root = outline_root(mask).to(drawn) if outline is None else outline
    return 0.5 * (_ring(drawn * keep) * root).sum((-2, -1))


def outline_root(mask: Float[Tensor, "objects h w"]) -> Float[Tensor, "objects h w"]:
    """Root of the distance to the ring of the mask [px^0.5]."""
    return _distance_to(_ring((mask > 0.5).to(mask))).sqrt()


def _ring(image: Float[Tensor, "*batch h w"]) -> Float[Tensor, "*batch h w"]:
    """What the highest pixel around exceeds each by; rows first, which finds the same pixel."""
    flat, reach = image.reshape(-1, 1, *image.shape[-2:]), RING // 2
    grown = torch.nn.functional.max_pool2d(flat, (1, RING), stride=1, padding=(0, reach))
    grown = torch.nn.functional.max_pool2d(grown, (RING, 1), stride=1, padding=(reach, 0))
    return grown.reshape(image.shape) - image


def _distance_to(edges: Float[Tensor, "objects h w"]) -> Float[Tensor, "objects h w"]:
    """Euclidean distance to the nearest edge pixel [px]."""
    from scipy.ndimage import distance_transform_edt

    maps = [torch.from_numpy(distance_transform_edt((e == 0).cpu().numpy())) for e in edges]
    return torch.stack(maps).to(edges)
