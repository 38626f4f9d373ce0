"""Starts of the descent: turned to the people, spread, thinned out, chosen."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import to_device
from mover.core.types import Layout, Objects, SceneObject
from mover.energy.human_terms import ContactPoints
from mover.furniture.library import WALL_PIECES
from mover.geometry.boxes import box_of
from mover.geometry.rotations import wrap

TURNED = math.radians(20)  # candidates nearer than this in yaw,
MOVED = 0.3  # and than this in position [m], are one
BEHIND = -0.25  # mean cosine of the angle from front to people, at most, of what faces away


def facing(layout: Layout, people: Float[Tensor, "bodies 3"]) -> Float[Tensor, " objects"]:
    """Mean cosine of the angle from above between each object's front and the way to people."""
    front = torch.stack([layout.yaw.sin(), layout.yaw.cos()], -1)
    way = people[None, :, [0, 2]].to(front) - layout.t_world_object[:, None, [0, 2]]
    return (torch.nn.functional.normalize(way, dim=-1) * front[:, None]).sum(-1).mean(1)


def turned_to_people(
    layout: Layout, categories: tuple[str, ...], people: Float[Tensor, "bodies 3"]
) -> Layout:
    """Turn objects along walls whose back faces people by the best number of quarters (ours)."""
    along = torch.tensor([name in WALL_PIECES for name in categories], device=layout.yaw.device)
    if not len(people) or not bool(along.any()):
        return layout
    yaws = torch.stack([wrap(layout.yaw + k * math.pi / 2) for k in range(4)])
    faces = torch.stack([facing(replace(layout, yaw=yaw), people) for yaw in yaws])
    best = torch.where(along & (faces[0] < BEHIND), faces.argmax(0), 0)
    return replace(layout, yaw=yaws.gather(0, best[None])[0])


def spread(layout: Layout, yaws: int) -> Layout:
    """Each start turned evenly round, the unturned ones first."""
    turns = torch.arange(yaws).to(layout.yaw) * (2 * math.pi / yaws)
    yaw = wrap(layout.yaw + turns[:, None, None]).flatten(0, 1)
    return replace(Layout.cat(*[layout] * yaws), yaw=yaw)


def best_few(layout: Layout, energy: Float[Tensor, "starts objects"], keep: int) -> Layout:
    """For each object its best starts that really differ, best first.

    Where fewer than `keep` differ, the best of the rest fill up, so that all objects have as many.
    Of equals the first is better: an object without evidence keeps the start that was given.
    """
    order, near = energy.argsort(dim=0, stable=True), to_device(layout, "cpu")
    columns = [_differing(near, order[:, i], i) for i in range(order.shape[1])]
    return layout.gather(torch.stack(columns, 1).to(order.device)[:keep])


def _differing(layout: Layout, order: Tensor, index: int) -> Tensor:
    """Indices of one object's starts: those that differ from all better ones, then the rest."""
    kept: list[int] = []
    rest: list[int] = []
    for start in order.tolist():
        yaw, place = layout.yaw[start, index], layout.t_world_object[start, index]
        same = any(
            float(wrap(yaw - layout.yaw[k, index]).abs()) < TURNED
            and float((place - layout.t_world_object[k, index]).norm()) < MOVED
            for k in kept
        )
        (rest if same else kept).append(start)
    return torch.tensor(kept + rest)


def choose(
    layout: Layout,
    energy: Float[Tensor, "starts objects"],
    reference: Float[Tensor, " objects"],
    yaw_prior_weight: float,
) -> Layout:
    """The best start of each object.

    Tables and cabinets look the same when turned, so a turn away from the reference yaw counts:
    candidates rank by (E + 0.01) (1 + yaw_prior_weight (1 - cos d) / 2), relative so that wrong
    shapes, whose energy is high, are not turned for a small gain.
    """
    turned = 1 - (layout.yaw - reference).cos()
    rank = (energy + 0.01) * (1 + yaw_prior_weight * turned / 2)
    return layout.gather(rank.argmin(0, keepdim=True))[0]


def reference_yaw(
    initial: Float[Tensor, " objects"], touches: ContactPoints | None
) -> Float[Tensor, " objects"]:
    """Yaw of the people on it, else the initial one [rad]."""
    yaw = initial.clone()
    if touches is not None:
        x, z = touches.heading.unbind(-1)
        seated = ((x.abs() + z.abs()) > 0) & ~touches.across
        yaw[touches.object_of[seated]] = torch.atan2(x, z)[seated]
    return yaw


def piles_of(supports: Int[Tensor, " objects"]) -> Int[Tensor, " objects"]:
    """The lowest of those that stand on one another, for each object."""
    n = len(supports)
    root = torch.where(supports >= 0, supports, torch.arange(n).to(supports))
    for _ in range(n):
        root = root[root]
    return root


def duplicates_of(layout: Layout, pile: Int[Tensor, " objects"]) -> Int[Tensor, "starts objects"]:
    """For each start of each object the first one that begins where it does, with its pile."""
    starts, n = layout.yaw.shape
    first = torch.zeros(starts, n).to(pile)
    known = torch.cat([layout.t_world_object, layout.yaw[..., None], layout.log_scale], -1)
    for number in range(starts):  # memory stays that of one
        other = (known[: number + 1] != known[number]).any(-1)
        among = torch.zeros_like(other, dtype=torch.int64).index_add(1, pile, other.long())
        first[number] = (among[:, pile] == 0).int().argmax(0)
    return first


def other_starts(others: Sequence[SceneObject], objects: Objects, start: Layout) -> Layout:
    """Starts in which each object stands as its next hypothesis says.

    An object keeps its own shape, and gets the position, front and size of the hypothesis with its
    id; one with fewer hypotheses than others stays at its start in the rest. Hypotheses of unknown
    objects are left out.
    """
    index = {name: i for i, name in enumerate(objects.ids)}
    known = [piece for piece in others if piece.id in index]
    ranks = dict.fromkeys(objects.ids, 0)
    count = max((sum(piece.id == name for piece in known) for name in index), default=0)
    place = start.t_world_object.repeat(count, 1, 1)
    yaw, sizes = start.yaw.repeat(count, 1), start.log_scale.repeat(count, 1, 1)
    for piece in known:
        rank, k, box = ranks[piece.id], index[piece.id], box_of(piece)
        ranks[piece.id] += 1
        half = torch.stack([torch.zeros(()), box.size[1] / 2, torch.zeros(())])
        place[rank, k] = (box.center - half).to(place)
        yaw[rank, k] = piece.yaw.to(yaw)
        sizes[rank, k] = (box.size.to(sizes) / objects.size[k]).log()
    return Layout(place, yaw, sizes)
