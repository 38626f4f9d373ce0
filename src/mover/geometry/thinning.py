"""Orders of points: neighbours together, and each next one the farthest from those before."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.warp_start import kernels, started

BITS = 10  # of a place along each axis, where neighbours are put together


def z_order(
    points: Float[Tensor, "*b points 3"],
    low: Float[Tensor, "*b 1 3"],
    high: Float[Tensor, "*b 1 3"],
) -> Int[Tensor, "*b points"]:
    """Numbers of the points along a curve that fills a box: neighbours get near ones (Morton)."""
    most = (1 << BITS) - 1
    cell = ((points - low) / (high - low).clamp_min(1e-6) * most).long()
    code = torch.zeros_like(cell[..., 0])
    for bit in range(BITS):
        for axis in range(3):
            code = code | ((cell[..., axis] >> bit & 1) << (3 * bit + axis))
    return code


def farthest_first(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """The first point, and so on the one that is farthest from all before; the first of equals."""
    spots = points.detach().cpu().float()
    low, high = spots.amin(0, keepdim=True), spots.amax(0, keepdim=True)
    index = z_order(spots, low, high).argsort(stable=True)
    wp, module = started(), kernels("farthest", "cpu")
    ordered = spots[index].contiguous()
    blocks = ordered.split(module.BLOCK)
    chosen = torch.zeros(count, dtype=torch.long)
    crowd = module.Crowd()
    crowd.points = wp.from_torch(ordered, dtype=wp.vec3)
    crowd.index = wp.from_torch(index)
    crowd.nearest = wp.from_torch(torch.full_like(ordered[:, 0], torch.inf))
    crowd.low = wp.from_torch(torch.stack([b.amin(0) for b in blocks]), dtype=wp.vec3)
    crowd.high = wp.from_torch(torch.stack([b.amax(0) for b in blocks]), dtype=wp.vec3)
    crowd.most = wp.from_torch(torch.full((len(blocks),), torch.inf))
    crowd.place = wp.from_torch(torch.zeros(len(blocks), dtype=torch.int32))
    first = int((index == 0).nonzero()[0])
    wp.launch(module.farthest, 1, [crowd, first, wp.from_torch(chosen)], device="cpu")
    return chosen.to(points.device)
