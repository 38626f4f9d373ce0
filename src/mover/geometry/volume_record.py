"""A scalar field on a regular grid."""

from functools import cached_property

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..records import record

SHELL = 2.0  # [cells], up to where it is exact outside: what `near_surface` finds, more than a
# cell's diagonal
BAND = 4.0  # [cells], what stands for any larger distance

BRICK = 8  # [cells]


@record
class Volume:
    """A scalar field sampled at the centres of cubic cells."""

    values: Float[Tensor, "x y z"]
    """Signed distance [m], negative inside; a positive constant away from the bodies."""
    origin: Float[Tensor, "3"]
    """Centre of cell (0, 0, 0) in the world [m]."""
    cell: float
    """Edge of a cell [m]."""

    @cached_property
    def corner(self) -> tuple[float, float, float]:
        """The origin as numbers [m]."""
        x, y, z = self.origin.tolist()
        return x, y, z

    @cached_property
    def busy(self) -> UInt8[Tensor, "bx by bz"]:
        """1 for each brick of 8 cells along an axis in which the values change, else 0."""
        low = high = self.values.detach()
        for axis, size in enumerate(self.values.shape):
            index = torch.arange(-(-(size - 1) // BRICK) * BRICK + 1, device=low.device)
            index = index.clamp_max(size - 1)
            low = low.index_select(axis, index).unfold(axis, BRICK + 1, BRICK).amin(-1)
            high = high.index_select(axis, index).unfold(axis, BRICK + 1, BRICK).amax(-1)
        return (low != high).to(torch.uint8)
