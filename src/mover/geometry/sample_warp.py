"""The trilinear lookup as a Warp kernel: value and gradient in one pass, skipping empty space."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from .kernels.start import kernels, launch, name_of, started
from .volume_record import Volume


def sample(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """See `volume.sample`; values and points are float32, and the values have no gradient."""
    found = _Lookup.apply(points, volume)
    assert isinstance(found, Tensor)
    return found


class _Lookup(torch.autograd.Function):
    """Keeps the gradient of the field at each point."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, volume: Volume) -> Tensor:  # noqa: ANN401
        wp = started()
        kernels("lookup", name_of(points.device))
        from .kernels.lookup import Field, lookup

        flat = points.detach().reshape(-1, 3).contiguous()
        found, slope = flat.new_empty(len(flat)), torch.empty_like(flat)
        if len(flat):
            field = Field()
            field.values = wp.from_torch(volume.values.detach())
            field.busy = wp.from_torch(volume.busy)
            field.origin = wp.vec3(*volume.corner)
            field.cell = volume.cell
            arrays = [
                wp.from_torch(flat, dtype=wp.vec3),
                wp.from_torch(found),
                wp.from_torch(slope, dtype=wp.vec3),
            ]
            launch(lookup, len(flat), [field, *arrays], flat.device)
        ctx.save_for_backward(slope)
        return found.reshape(points.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope.reshape(*grads[0].shape, 3) * grads[0].unsqueeze(-1), None
