r"""Touching surfaces share a place (Sec. 3.1, "Contact constraint").

Evidence:  body points that touch, from all frames, each assigned to one object and to its part: to
           the seat or top (C(O)^y) if its normal lies within 45 degrees of the vertical, else to
           the back (C(O)^{\perp y}); thinned to small cells whose weight counts the points inside.
Price:     L_contact = \sum_i \sum_v I(v, O_i)
           [CD(v^y, C(O_i)^y) + CD(v^{\perp y}, C(O_i)^{\perp y})]
Paper:     CD is the distance from a body point to the nearest point of the object's part.
Release:   from each point of the object's part to the nearest body point, its mean; body and hands
           apart.
Robust:    the mean of a Geman-McClure price (rho 0.3 m) from body to object, in full only once four
           bodies touch, the back a quarter of the seat; so that contact neither drags an object by
           a few wrong points nor rules its size. `heading_term` turns seats with their sitters.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..constants import constant
from ..minimize import geman_mcclure, safe_norm
from ..records import record
from ..types import Layout
from . import Form

RHO = 0.3  # [m], docs/method.md: 0.15 gives up on pieces half a metre away
ENOUGH = 4.0  # bodies that touch before contact counts in full
PARTS = 4  # seat or top, back; then the same for hands
SHARE = (1.0, 0.25, 1.0, 0.25)  # of the parts in the robust price


@record
class Touches:
    """Body points that touch furniture, from all frames, packed over the touched objects."""

    object_of: Int[Tensor, " touched"]
    """Index of each touched object."""
    points: Float[Tensor, "touched 4 points 3"]
    """Places in the world [m] by part: top, back, top by hand, back by hand."""
    weight: Float[Tensor, "touched 4 points"]
    """Body vertices that a point stands for; 0 pads."""
    bodies: Float[Tensor, " touched"]
    """Number of bodies that touch the object."""
    heading: Float[Tensor, "touched 2"]
    """Mean direction (x, z) that its sitters face, a unit vector; zero where nobody sits."""


def contact_term(
    regions: tuple[
        Float[Tensor, "*starts objects region 3"], Float[Tensor, "*starts objects region 3"]
    ],
    touches: Touches,
    form: Form,
) -> Float[Tensor, "*starts objects"]:
    """Distance between body points and the parts of the object that they touch.

    Args:
        regions: Points of the top and of the back of each object, placed [m].
        touches: The body points.
        form: `paper` and `release` [m], `robust` [1].
    """
    top, back = (r[..., touches.object_of, :, :].unsqueeze(-3) for r in regions)
    parts = torch.cat([top, back, top, back], -3)  # *starts touched 4 region 3
    if form == "release":
        price = _to_bodies(parts, touches)
    else:
        near = _nearest(touches.points.expand(*parts.shape[:-2], -1, 3), parts)
        price = _price(near, touches, form)
    total = torch.zeros_like(regions[0][..., 0, 0])
    return total.index_add(-1, touches.object_of, price)


def gap_term(
    gaps: Float[Tensor, "*starts touched 4 points"], touches: Touches, objects: int, form: Form
) -> Float[Tensor, "*starts objects"]:
    """`contact_term` of `paper` and `robust`, from distances that are known [m]."""
    price = _price(gaps, touches, form)
    total = price.new_zeros(*price.shape[:-1], objects)
    return total.index_add(-1, touches.object_of, price)


def _price(near: Tensor, touches: Touches, form: Form) -> Float[Tensor, "*starts touched"]:
    if form == "paper":
        return (near * touches.weight).sum((-2, -1))
    share = constant(SHARE, near)
    mean = (geman_mcclure(near, RHO) * touches.weight).sum(-1)
    mean = mean / touches.weight.sum(-1).clamp_min(1e-9)
    return (mean * share).sum(-1) * (touches.bodies / ENOUGH).clamp_max(1)


def _to_bodies(parts: Tensor, touches: Touches) -> Float[Tensor, "*starts touched"]:
    far_away = torch.where(touches.weight.unsqueeze(-1) > 0, touches.points, 1e3)
    near = _nearest(parts, far_away.expand(*parts.shape[:-2], -1, 3))
    known = (touches.weight > 0).any(-1)
    return (near.mean(-1) * known).sum(-1)


def _nearest(
    points: Float[Tensor, "*batch points 3"], others: Float[Tensor, "*batch others 3"]
) -> Float[Tensor, "*batch points"]:
    """Distance from each point to the nearest other point [m]; the pairing has no gradient."""
    with torch.no_grad():
        index = torch.cdist(points, others).argmin(-1, keepdim=True)
    partner = others.gather(-2, index.expand(*index.shape[:-1], 3))
    return safe_norm(points - partner)


def heading_term(layout: Layout, touches: Touches) -> Float[Tensor, "*starts objects"]:
    """Seats face where their sitters face: 1 - cos of the angle between them (`robust` only)."""
    yaw = layout.yaw[..., touches.object_of]
    facing = yaw.sin() * touches.heading[:, 0] + yaw.cos() * touches.heading[:, 1]
    seated = touches.heading.square().sum(-1) > 0
    price = torch.where(seated, 1 - facing, torch.zeros_like(facing))
    return torch.zeros_like(layout.yaw).index_add(-1, touches.object_of, price)
