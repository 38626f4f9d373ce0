"""Contact as in `paper` and `release`, by search trees and with its gradient in closed form."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.nearest_warp import Clouds
from ..geometry.reach_warp import FromObject, FromWorld, Way, reach
from ..geometry.thinning import BITS, z_order
from ..types import Layout
from . import Form
from .contact import PARTS, Touches
from .contact_trees import Trees


def reach_term(
    layout: Layout, touches: Touches, trees: Trees, form: Form
) -> Float[Tensor, "*starts objects"]:
    """`contact_term` of `paper` and `release` [m].

    Raises:
        ValueError: If the form is `robust`.
    """
    if form == "robust":
        raise ValueError("reach_term: form 'robust', expected 'paper' or 'release'")
    item = touches.object_of
    few = (layout.t_world_object, layout.yaw.unsqueeze(-1), layout.log_scale)
    pose = torch.cat(few, -1)[..., item, :]
    ways = _from_world(touches, trees) if form == "paper" else _from_object(touches, trees)
    return torch.zeros_like(layout.yaw).index_add(-1, item, reach(pose, item, ways))


def _regions(trees: Trees) -> tuple[Clouds, ...]:
    """What each of the parts touches: top, back, top by hand, back by hand."""
    return (trees.top, trees.back) * (PARTS // 2)


def _from_world(touches: Touches, trees: Trees) -> tuple[Way, ...]:
    return tuple(
        FromWorld(touches.points[:, k], touches.weight[:, k], region)
        for k, region in enumerate(_regions(trees))
    )


def _from_object(touches: Touches, trees: Trees) -> tuple[Way, ...]:
    known = (touches.weight > 0).any(-1)
    return tuple(
        FromObject(region, skin, known[:, k])
        for k, (region, skin) in enumerate(zip(_regions(trees), trees.skin or (), strict=False))
    )


def together(touches: Touches) -> Touches:
    """The same evidence in another order: points with a weight first, neighbours together."""
    known, points = (touches.weight > 0).unsqueeze(-1), touches.points
    low = torch.where(known, points, torch.inf).amin(-2, keepdim=True)
    high = torch.where(known, points, -torch.inf).amax(-2, keepdim=True)
    code = torch.where(known[..., 0], z_order(points, low, high), 1 << 3 * BITS)
    order = code.argsort(dim=-1, stable=True)
    return replace(
        touches,
        points=points.gather(-2, order.unsqueeze(-1).expand_as(points)),
        weight=touches.weight.gather(-1, order),
    )
