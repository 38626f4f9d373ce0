"""How the terms of Eq. 1 pull at a result, and how they bend around it.

Unknowns of an object, in their order: x, y, z of the middle of its base [m], yaw [rad], and the
logarithms of its three scales. Gradients are exact; their change over a step that is as large as
the doubts one wants to tell (centimetres) gives the curvature, so that the ruggedness of pixels
and the corners of one-sided prices are averaged out.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..minimize import Energy
from ..records import record
from ..types import Layout

STEPS = (0.03, 0.03, 0.03, 0.05, 0.03, 0.03, 0.03)  # of the differences [m, rad, 1]


@record
class Bend:
    """Each term at the result, to second order; terms are named in `terms`."""

    terms: tuple[str, ...]
    value: Float[Tensor, "terms objects"]
    slope: Float[Tensor, "terms objects 7"]
    """Gradient, averaged over the steps [1/m, 1/rad, 1]."""
    curve: Float[Tensor, "terms objects 7 7"]
    """Second derivatives."""


def bend_at(energy: Callable[[Layout], Energy], layout: Layout) -> Bend:
    """Values, gradients and second derivatives of every term for every object.

    All objects take their steps at once. No term couples two objects but for the height of a
    carrier, which lifts its load: the load's price then belongs to the carrier as well.

    Args:
        energy: Of layouts with a leading axis of starts, one value for each object.
        layout: The result.
    """
    steps = torch.tensor(STEPS, dtype=torch.float64)
    moves = torch.cat([torch.zeros(1, 7), torch.diag(steps), -torch.diag(steps)]).to(steps)
    free = (vector(layout).double() + moves[:, None]).to(layout.yaw).requires_grad_()
    parts = energy(unvector(free)).parts
    slopes = torch.stack([_slope(part, free) for part in parts.values()]).double()
    plus, minus = slopes[:, 1:8], slopes[:, 8:]
    curve = ((plus - minus) / (2 * steps[:, None, None])).permute(0, 2, 3, 1)
    value = torch.stack([part[0].detach().double() for part in parts.values()])
    middle = (slopes[:, 0] + plus.mean(1) + minus.mean(1)) / 3
    return Bend(tuple(parts), value, middle, (curve + curve.mT) / 2)


def vector(layout: Layout) -> Float[Tensor, "*starts objects 7"]:
    """The unknowns of each object as one row."""
    return torch.cat([layout.t_world_object, layout.yaw.unsqueeze(-1), layout.log_scale], -1)


def unvector(rows: Float[Tensor, "*starts objects 7"]) -> Layout:
    """The inverse of `vector`."""
    return Layout(rows[..., :3], rows[..., 3], rows[..., 4:])


def _slope(part: Tensor, free: Tensor) -> Tensor:
    if not part.requires_grad:
        return torch.zeros_like(free)
    return torch.autograd.grad(
        part.sum(), free, retain_graph=True, allow_unused=True, materialize_grads=True
    )[0]
