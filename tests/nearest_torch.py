"""The nearest points by all distances: the reference of the kernel."""

from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.nearest_warp import Clouds


def nearest_torch(
    held: Clouds,
    query: Float[Tensor, "*starts objects queries 3"],
    scale: Float[Tensor, "*starts objects 3"],
) -> Int[Tensor, "*starts objects queries"]:
    """See `nearest_warp.nearest`."""
    placed = held.points * scale.detach().unsqueeze(-2)
    gap = query.detach().unsqueeze(-2) - placed.unsqueeze(-3)
    closest = gap.square().sum(-1).argmin(-1)
    return held.index.expand(*query.shape[:-2], -1).gather(-1, closest)
