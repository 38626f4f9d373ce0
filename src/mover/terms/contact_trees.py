"""The nearest points of the contact term from search trees that are built once."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.nearest_warp import Clouds, clouds, nearest
from ..geometry.raster_engine import engine
from ..geometry.rotations import rot_y
from ..minimize import safe_norm
from ..records import map_tensors, record
from ..types import Layout, Objects
from .contact import Touches


@record
class Trees:
    """What can be touched of each object, and which points of the evidence ask for it."""

    top: Clouds
    back: Clouds
    asking: Bool[Tensor, "objects 2 points"]
    """By top and back: whether points of the body, then of the hands, have a weight."""


def trees_of(objects: Objects, touches: Touches) -> Trees | None:
    """Search trees of all objects; None where Warp is not the engine or cannot help."""
    if engine() != "warp" or objects.top.dtype != torch.float32 or not objects.top.numel():
        return None
    weighty = _by_region(touches.weight > 0)
    asking = weighty.new_zeros(len(objects.ids), *weighty.shape[1:])
    asking[touches.object_of] = weighty
    return Trees(clouds(objects.top), clouds(objects.back), asking)


def some_trees(trees: Trees | None, index: Tensor) -> Trees | None:
    """The trees of the objects of this index."""
    return None if trees is None else map_tensors(lambda x: x[index], trees)


def gaps(
    layout: Layout, objects: Objects, touches: Touches, trees: Trees
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
        order = order[:, : int(asking.sum(-1).max()) if len(index) else 0]
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
