"""The nearest points of the contact term from search trees that are built once."""

from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.nearest_warp import Clouds, clouds, nearest
from ..geometry.raster_engine import engine
from ..geometry.rotations import rot_y
from ..minimize import safe_norm
from ..records import map_tensors, record
from ..types import Layout, Objects
from . import Form
from .contact import PARTS, Touches

FAR_AWAY = 1e3  # [m], where points without weight are put


@record
class Trees:
    """What can be touched of each object, and which points of the evidence ask for it."""

    top: Clouds
    back: Clouds
    asking: Bool[Tensor, "objects 2 points"]
    """By top and back: whether points of the body, then of the hands, have a weight."""
    skin: tuple[Clouds, ...] | None = None
    """The points of the evidence, by part (`release` only); meaningless where none has a weight."""

    @cached_property
    def most(self) -> tuple[int, ...]:
        """Most points that ask for the top, and for the back, of one object."""
        counts = self.asking.sum(-1)
        return tuple(counts.amax(0).tolist()) if len(counts) else (0, 0)


def trees_of(objects: Objects, touches: Touches, form: Form = "robust") -> Trees | None:
    """Search trees of all objects; None where Warp is not the engine or cannot help."""
    if engine() != "warp" or objects.top.dtype != torch.float32 or not objects.top.numel():
        return None
    weighty = _by_region(touches.weight > 0)
    asking = weighty.new_zeros(len(objects.ids), *weighty.shape[1:])
    asking[touches.object_of] = weighty
    skin = _skin(touches, len(objects.ids)) if form == "release" else None
    return Trees(clouds(objects.top), clouds(objects.back), asking, skin)


def _skin(touches: Touches, objects: int) -> tuple[Clouds, ...] | None:
    """Search trees of the points of each part; None where nothing is touched."""
    known, index = touches.weight > 0, touches.object_of
    if not bool(known.any()):
        return None
    points = torch.where(known.unsqueeze(-1), touches.points.detach(), FAR_AWAY)
    found: list[Clouds] = []
    for part in range(PARTS):
        order = known[:, part].byte().argsort(dim=-1, descending=True, stable=True)
        order = order[:, : max(1, int(known[:, part].sum(-1).max()))]
        some = clouds(points[:, part].gather(-2, order.unsqueeze(-1).expand(-1, -1, 3)))
        found.append(map_tensors(lambda x: _spread(x, index, objects), some))
    return tuple(found)


def _spread(rows: Tensor, index: Tensor, objects: int) -> Tensor:
    return rows.new_zeros(objects, *rows.shape[1:]).index_copy(0, index, rows)


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
