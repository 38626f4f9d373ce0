r"""Bend a mesh with a cage: 27 control points on its box (free-form deformation, Sederberg 1986).

    x' = x + \sum_{ijk} B_i(u) B_j(v) B_k(w) d_{ijk},   (u, v, w) the place of x in the box,

with B the Bernstein polynomials of degree 2. Faces, materials and textures stay as they are, and a
closed mesh stays closed.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import Cage

OUTSIDE = 0.05  # of the box: points farther outside follow those there


def bent(points: Float[Tensor, "*items points 3"], cage: Cage) -> Float[Tensor, "*items points 3"]:
    """Points moved with the cage about them; a cage for each item."""
    low, size = cage.low.unsqueeze(-2), (cage.high - cage.low).clamp_min(1e-9).unsqueeze(-2)
    share = ((points - low) / size).clamp(-OUTSIDE, 1 + OUTSIDE)
    rest = 1 - share
    basis = torch.stack([rest.square(), 2 * share * rest, share.square()], -1)
    x, y, z = basis.unbind(-2)
    return points + torch.einsum("...pi,...pj,...pk,...ijkc->...pc", x, y, z, cage.offset)


def even(free: Float[Tensor, "items 3 3 3 3"]) -> Float[Tensor, "items 3 3 3 3"]:
    """The part of offsets that bends: the same left and right, flat below, no place and no size.

    What moves, turns, stretches or shears the whole is taken out (least squares on the control
    points): it belongs to the placement.
    """
    mirror = free.new_tensor([-1.0, 1.0, 1.0])
    both = (free + mirror * free.flip(1)) / 2
    half = torch.linspace(-1, 1, 3).to(free)
    x, y, z = (axis.flatten() for axis in torch.meshgrid(half, half, half, indexing="ij"))
    whole, _ = torch.linalg.qr(torch.stack([torch.ones_like(x), x, y, z], -1))
    level = both[..., [0, 2]].flatten(1, 3)
    level = level - whole @ (whole.mT @ level)
    up = (y + 1) / (y + 1).norm()
    rise = both[..., 1].flatten(1) * (y > -1)
    rise = rise - (rise @ up).unsqueeze(-1) * up
    return torch.stack([level[..., 0], rise, level[..., 1]], -1).reshape(free.shape)
