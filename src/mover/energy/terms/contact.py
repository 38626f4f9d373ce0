r"""Touching surfaces share a place (Sec. 3.1, "Contact constraint").

Evidence:  body points that touch, from all frames, each assigned to one object and to its part: to
           the seat or top (C(O)^y) if its normal lies within 45 degrees of the vertical, else to
           the back (C(O)^{\perp y}); thinned to small cells whose weight counts the points inside.
Price:     L_contact = \sum_i \sum_v I(v, O_i)
           [CD(v^y, C(O_i)^y) + CD(v^{\perp y}, C(O_i)^{\perp y})]
Paper:     CD is a mean over its source points, which the sum prints: all touching skin of the
           people, of which I(v, O_i) picks what touches this object. So what many bodies touch
           weighs more than what a few stray vertices touch. Body and hands together.
Robust:    the mean of a Geman-McClure price (rho 0.3 m) from body to object, in full only once four
           bodies touch, the back a quarter of the seat; so that contact neither drags an object by
           a few wrong points nor rules its size. `heading_term` turns seats with their sitters
           and beds with those who lie on them.
"""

from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.core.records import map_tensors, record
from mover.core.types import Layout, Objects
from mover.energy.config import Variant
from mover.energy.minimize import geman_mcclure, safe_norm
from mover.geometry.nearest_warp import Clouds, clouds, nearest
from mover.geometry.raster import engine
from mover.geometry.rotations import rot_y

RHO = 0.3  # [m], docs/method.md: 0.15 gives up on pieces half a metre away
ENOUGH = 4.0  # bodies that touch before contact counts in full
SHARE = (1.0, 0.25, 1.0, 0.25)  # of seat or top, back, then the same for hands


@record
class ContactPoints:
    """Body points that touch furniture, from all frames, packed over the touched objects."""

    object_of: Int[Tensor, " touched"]
    """Index of each touched object."""
    points: Float[Tensor, "touched 4 points 3"]
    """Places in the world [m] by part: top, back, top by hand, back by hand."""
    weight: Float[Tensor, "touched 4 points"]
    """Body vertices that a point stands for; 0 pads."""
    bodies: Float[Tensor, " touched"]
    """Number of bodies that touch the object."""
    share: Float[Tensor, "touched 4"]
    """Of all body vertices that touch seats and tops, or backs, those that touch this part [1]."""
    heading: Float[Tensor, "touched 2"]
    """Mean direction (x, z) that its sitters face, or that who lies on a bed stretches to from the
    neck to the hips, a unit vector; zero where nobody tells it."""


def shares_of(weight: Float[Tensor, "touched 4 points"]) -> Float[Tensor, "touched 4"]:
    """Of all vertices that touch seats and tops, or backs, those that touch each part."""
    counts = weight.sum(-1)
    of_region = counts.unflatten(-1, (2, 2)).sum((0, 1))
    return counts / of_region.clamp_min(1e-9).repeat(2)


def some_touches(touches: ContactPoints, index: Int[Tensor, " few"], count: int) -> ContactPoints:
    """The evidence about the objects of this index, out of `count`."""
    row = torch.full((count,), -1).to(index)
    row[touches.object_of] = torch.arange(len(touches.object_of)).to(index)
    touched = torch.nonzero(row[index] >= 0)[:, 0]
    few = row[index[touched]]
    rest = {k: getattr(touches, k)[few] for k in ("points", "weight", "bodies", "share", "heading")}
    return ContactPoints(touched, **rest)


def contact_term(
    regions: tuple[
        Float[Tensor, "*starts objects region 3"], Float[Tensor, "*starts objects region 3"]
    ],
    touches: ContactPoints,
    form: Variant,
) -> Float[Tensor, "*starts objects"]:
    """Distance between body points and the parts of the object that they touch.

    Args:
        regions: Points of the top and of the back of each object, placed [m].
        touches: The body points.
        form: `paper` [m], `robust` [1].
    """
    top, back = (r[..., touches.object_of, :, :].unsqueeze(-3) for r in regions)
    parts = torch.cat([top, back, top, back], -3)  # *starts touched 4 region 3
    near = _nearest(touches.points.expand(*parts.shape[:-2], -1, 3), parts)
    price = _price(near, touches, form)
    total = torch.zeros_like(regions[0][..., 0, 0])
    return total.index_add(-1, touches.object_of, price)


def gap_term(
    gaps: Float[Tensor, "*starts touched 4 points"],
    touches: ContactPoints,
    objects: int,
    form: Variant,
) -> Float[Tensor, "*starts objects"]:
    """`contact_term` from distances that are known [m]."""
    price = _price(gaps, touches, form)
    total = price.new_zeros(*price.shape[:-1], objects)
    return total.index_add(-1, touches.object_of, price)


def _price(near: Tensor, touches: ContactPoints, form: Variant) -> Float[Tensor, "*starts touched"]:
    if form == "paper":
        mean = (near * touches.weight).sum(-1) / touches.weight.sum(-1).clamp_min(1e-9)
        return (mean * touches.share).sum(-1)
    share = constant(SHARE, near)
    mean = (geman_mcclure(near, RHO) * touches.weight).sum(-1)
    mean = mean / touches.weight.sum(-1).clamp_min(1e-9)
    return (mean * share).sum(-1) * (touches.bodies / ENOUGH).clamp_max(1)


def _nearest(
    points: Float[Tensor, "*batch points 3"], others: Float[Tensor, "*batch others 3"]
) -> Float[Tensor, "*batch points"]:
    """Distance from each point to the nearest other point [m]; the pairing has no gradient."""
    with torch.no_grad():
        index = torch.cdist(points, others).argmin(-1, keepdim=True)
    partner = others.gather(-2, index.expand(*index.shape[:-1], 3))
    return safe_norm(points - partner)


def heading_term(layout: Layout, touches: ContactPoints) -> Float[Tensor, "*starts objects"]:
    """Seats face as their sitters, beds run as who lies: 1 - cos of the angle (`robust` only)."""
    yaw = layout.yaw[..., touches.object_of]
    facing = yaw.sin() * touches.heading[:, 0] + yaw.cos() * touches.heading[:, 1]
    seated = touches.heading.square().sum(-1) > 0
    price = torch.where(seated, 1 - facing, torch.zeros_like(facing))
    return torch.zeros_like(layout.yaw).index_add(-1, touches.object_of, price)


# The nearest points of the contact term from search trees that are built once.


@record
class Trees:
    """What can be touched of each object, and which points of the evidence ask for it."""

    top: Clouds
    back: Clouds
    asking: Bool[Tensor, "objects 2 points"]
    """By top and back: whether points of the body, then of the hands, have a weight."""

    @cached_property
    def most(self) -> tuple[int, ...]:
        """Most points that ask for the top, and for the back, of one object."""
        counts = self.asking.sum(-1)
        return tuple(counts.amax(0).tolist()) if len(counts) else (0, 0)


def trees_of(objects: Objects, touches: ContactPoints) -> Trees | None:
    """Search trees of all objects; None where Warp is not the engine or cannot help."""
    if engine() != "warp" or objects.top.dtype != torch.float32 or not objects.top.numel():
        return None
    weighty = _by_region(touches.weight > 0)
    asking = weighty.new_zeros(len(objects.ids), *weighty.shape[1:])
    asking[touches.object_of] = weighty
    return Trees(clouds(objects.top), clouds(objects.back), asking)


def gaps(
    layout: Layout, objects: Objects, touches: ContactPoints, trees: Trees
) -> Float[Tensor, "*starts touched 4 points"]:
    """Distance from each body point to the nearest point of the part that it touches [m].

    Points without weight may get zero.
    """
    index = touches.object_of
    few = Layout(
        layout.t_world_object[..., index, :],
        layout.yaw[..., index],
        layout.log_scale[..., index, :],
    )
    held = map_tensors(lambda x: x[index], trees)
    points, found = _by_region(touches.points), []
    for k, (region, tree) in enumerate(((objects.top, held.top), (objects.back, held.back))):
        asking = held.asking[:, k]
        order = asking.byte().argsort(dim=-1, descending=True, stable=True)
        order = order[:, : trees.most[k]]
        query = points[:, k].gather(-2, order.unsqueeze(-1).expand(-1, -1, 3))
        gap = _gap(few, query, region[index], tree)
        whole = gap.new_zeros(*gap.shape[:-1], points.shape[-2])
        found.append(whole.scatter(-1, order.expand(gap.shape), gap))
    both = torch.stack(found, -2).unflatten(-1, (2, -1))  # region, body or hand
    return both.transpose(-3, -2).flatten(-3, -2)


def _by_region(parts: Tensor) -> Tensor:
    """From (touched, 4 parts, points) to (touched, 2 regions, points of body and hand)."""
    return parts.unflatten(1, (2, 2)).transpose(1, 2).flatten(2, 3)


def _gap(few: Layout, points: Tensor, region: Tensor, tree: Clouds) -> Tensor:
    """Distance from points in the world to the nearest of the region; the pairing is constant."""
    turn, scale = rot_y(few.yaw), few.log_scale.exp()
    there = few.t_world_object.unsqueeze(-2)
    pair = nearest(tree, (points - there).detach() @ turn.detach(), scale)
    index = pair.unsqueeze(-1).expand(*pair.shape, 3)
    chosen = region.expand(*pair.shape[:-1], -1, 3).gather(-2, index)
    return safe_norm(points - (chosen * scale.unsqueeze(-2)) @ turn.mT - there)
