"""Sums over the pixels of windows, with their gradients in closed form."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from .kernels.start import kernels, launch, name_of, started
from .raster_engine import DEVICES, engine, threads
from .raster_warp_cpu import share


def squares(
    drawn: Float[Tensor, "*starts objects h w"],
    mask: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
) -> Float[Tensor, "*starts objects"]:
    """Sum of the kept squared differences; differentiable once, in what is drawn."""
    price = _Squares.apply(drawn, mask, keep)
    assert isinstance(price, Tensor)
    return price


def bounds_depths(depth: Tensor, *bounds: Tensor) -> bool:
    """Whether `outside` can price these maps: Warp is the engine, all is constant float32."""
    here = {(x.device, x.dtype) for x in (depth, *bounds)} == {(depth.device, torch.float32)}
    drawn = depth.device.type in DEVICES and depth.numel() > 0
    return engine() == "warp" and here and drawn and not any(x.requires_grad for x in bounds)


def outside(
    seen: tuple[Float[Tensor, "*starts objects h w"], Bool[Tensor, "*starts objects h w"]],
    mask: Float[Tensor, "objects h w"],
    bounds: tuple[Float[Tensor, "objects h w"], Float[Tensor, "objects h w"]],
    slack: tuple[float, float],
) -> tuple[Float[Tensor, "*starts objects"], Float[Tensor, "*starts objects"]]:
    """How far depths are out of bounds that agree, and how many pixels these bound.

    Args:
        seen: Depths [m] and where they are known.
        mask: Bounds count where it exceeds one half.
        bounds: Lowest and highest depth; infinite where there is none [m].
        slack: Margin of both bounds, most that a pixel can be outside [m].
    """
    price, count = _Outside.apply(*seen, (mask, *bounds), slack)
    return price, count


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


class _Outside(torch.autograd.Function):
    """Keeps the sign of each pixel's change."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        depth: Tensor,
        covered: Tensor,
        bounds: tuple[Tensor, Tensor, Tensor],
        slack: tuple[float, float],
    ) -> tuple[Tensor, Tensor]:
        lines = depth.shape[:-1]
        price, count = (depth.new_empty(lines.numel()) for _ in range(2))
        slope = torch.zeros_like(depth, memory_format=torch.contiguous_format)
        _launch([depth, covered], bounds, slack, [price, count, slope])
        ctx.save_for_backward(slope)
        number = count.view(lines).sum(-1)
        ctx.mark_non_differentiable(number)
        return price.view(lines).sum(-1), number

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None, None, None]:
        (slope,) = ctx.saved_tensors
        return slope * grads[0][..., None, None], None, None, None


def _launch(
    seen: list[Tensor],
    bounds: tuple[Tensor, Tensor, Tensor],
    slack: tuple[float, float],
    outputs: list[Tensor],
) -> None:
    """Price all rows, on a CPU a share of them in each thread."""
    device = seen[0].device
    module = kernels("price", name_of(device))
    inputs, arrays = ([_flat(x) for x in maps] for maps in (seen, outputs))
    rows = len(outputs[0])
    parts = min(threads(), rows) if device.type == "cpu" else 1
    cuts = [rows * k // parts for k in range(parts + 1)]

    def one(part: int) -> None:
        packed = module.Bounds()
        packed.mask, packed.near, packed.far = (_flat(x) for x in bounds)
        packed.width, packed.first = seen[0].shape[-1], cuts[part]
        packed.margin, packed.limit = slack
        size = cuts[part + 1] - cuts[part]
        launch(module.outside_rows, size, [*inputs, packed, *arrays], device)

    share(one, parts)


def _flat(values: Tensor) -> Any:  # noqa: ANN401
    return started().from_torch(values.detach().contiguous().view(-1))
