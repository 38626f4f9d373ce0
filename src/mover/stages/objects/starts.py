"""Several starts of the descent: spread, thin out, choose."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import to_device
from mover.core.types import Layout, Objects, SceneObject
from mover.energy.human_terms import ContactPoints
from mover.geometry.boxes import box_of
from mover.geometry.rotations import rot_y, wrap

TURNED = math.radians(20)  # candidates nearer than this in yaw,
MOVED = 0.3  # and than this in place [m], are one
SHAKE = (0.05, 0.05, 0.03)  # by which places [m], yaws [rad] and log scales are shaken


def spread(layout: Layout, yaws: int) -> Layout:
    """Each start turned evenly round, the unturned ones first."""
    turns = torch.arange(yaws).to(layout.yaw) * (2 * math.pi / yaws)
    yaw = wrap(layout.yaw + turns[:, None, None]).flatten(0, 1)
    return Layout(
        layout.t_world_object.repeat(yaws, 1, 1), yaw, layout.log_scale.repeat(yaws, 1, 1)
    )


def spread_distance(layout: Layout, factors: tuple[float, ...]) -> Layout:
    """Each start also nearer and farther along the floor, as large in the image as before."""
    found = [layout]
    for factor in factors:
        t = layout.t_world_object * layout.yaw.new_tensor([factor, 1.0, factor])
        found.append(Layout(t, layout.yaw, layout.log_scale + math.log(factor)))
    return Layout(
        torch.cat([f.t_world_object for f in found]),
        torch.cat([f.yaw for f in found]),
        torch.cat([f.log_scale for f in found]),
    )


def shaken(layout: Layout, times: int, number: int = 0) -> Layout:
    """Places around each start, the same in every run and for every object.

    Minima of Eq. 1 are rugged within a pixel or two; from around one the next, deeper one is found.

    Args:
        layout: The starts.
        times: Places around each.
        number: Of the round; in each, places are half as far off as in the one before.
    """
    generator = torch.Generator().manual_seed(number)
    draw = torch.randn(times, 7, generator=generator).to(layout.yaw) * 0.5**number
    place, turn, size = draw[:, None, :3], draw[:, None, 3], draw[:, None, 4:]
    t, yaw, log_scale = layout.t_world_object, layout.yaw, layout.log_scale
    return Layout(
        (t + SHAKE[0] * place[:, None]).flatten(0, 1),
        wrap(yaw + SHAKE[1] * turn[:, None]).flatten(0, 1),
        (log_scale + SHAKE[2] * size[:, None]).flatten(0, 1),
    )


def best_few(
    layout: Layout, energy: Float[Tensor, "starts objects"], keep: int, *, apart: bool = True
) -> Layout:
    """For each object its best starts, best first; `apart`: only such as really differ.

    Where fewer than `keep` differ, the best of the rest fill up, so that all objects have as many.
    """
    order = energy.argsort(0)
    if apart:
        near = to_device(layout, "cpu")
        columns = [_differing(near, order[:, i], i) for i in range(order.shape[1])]
        order = torch.stack(columns, 1).to(order.device)
    return pick(layout, order[:keep])


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


def pick(layout: Layout, index: Tensor) -> Layout:
    """Starts by index, an own one for each object: `index` is (new starts, objects)."""
    wide = index.unsqueeze(-1).expand(-1, -1, 3)
    return Layout(
        layout.t_world_object.gather(0, wide),
        layout.yaw.gather(0, index),
        layout.log_scale.gather(0, wide),
    )


def choose(
    layout: Layout,
    energy: Float[Tensor, "starts objects"],
    reference: Float[Tensor, " objects"],
    yaw_prior_weight: float,
) -> Layout:
    """The best start of each object.

    Tables and cabinets look alike when turned, so a turn away from the reference yaw counts:
    candidates rank by (E + 0.01) (1 + yaw_prior_weight (1 - cos d) / 2), relative so that wrong
    shapes, whose energy is high, are not turned for a small gain.
    """
    turned = 1 - (layout.yaw - reference).cos()
    rank = (energy + 0.01) * (1 + yaw_prior_weight * turned / 2)
    best = pick(layout, rank.argmin(0, keepdim=True))
    return Layout(best.t_world_object[0], best.yaw[0], best.log_scale[0])


def merged(first: Bool[Tensor, " objects"], one: Layout, other: Layout) -> Layout:
    """The first layout where `first`, else the other; either may have an axis of starts."""
    return Layout(
        torch.where(first[:, None], one.t_world_object, other.t_world_object),
        torch.where(first, one.yaw, other.yaw),
        torch.where(first[:, None], one.log_scale, other.log_scale),
    )


def alone(layout: Layout) -> Layout:
    """One layout as the only start."""
    return Layout(layout.t_world_object[None], layout.yaw[None], layout.log_scale[None])


def joined(a: Layout, b: Layout) -> Layout:
    """All starts of both."""
    return Layout(
        torch.cat([a.t_world_object, b.t_world_object]),
        torch.cat([a.yaw, b.yaw]),
        torch.cat([a.log_scale, b.log_scale]),
    )


def reference_yaw(
    initial: Float[Tensor, " objects"], touches: ContactPoints | None
) -> Float[Tensor, " objects"]:
    """Yaw of who sits or lies on it, else the initial one [rad]."""
    yaw = initial.clone()
    if touches is not None:
        x, z = touches.heading.unbind(-1)
        seated = (x.abs() + z.abs()) > 0
        yaw[touches.object_of[seated]] = torch.atan2(x, z)[seated]
    return yaw


def piles_of(supports: Int[Tensor, " objects"]) -> Int[Tensor, " objects"]:
    """The lowest of those that stand on one another, for each object."""
    n = len(supports)
    root = torch.where(supports >= 0, supports, torch.arange(n).to(supports))
    for _ in range(n):
        root = root[root]
    return root


def alike(layout: Layout, pile: Int[Tensor, " objects"]) -> Int[Tensor, "starts objects"]:
    """For each start of each object the first one that begins where it does, with its pile."""
    starts, n = layout.yaw.shape
    first = torch.zeros(starts, n).to(pile)
    known = torch.cat([layout.t_world_object, layout.yaw[..., None], layout.log_scale], -1)
    for number in range(starts):  # memory stays that of one
        other = (known[: number + 1] != known[number]).any(-1)
        among = torch.zeros_like(other, dtype=torch.int64).index_add(1, pile, other.long())
        first[number] = (among[:, pile] == 0).int().argmax(0)
    return first


# Further starts of the descent: other ways in which a first scene's objects may stand.


def other_starts(others: Sequence[SceneObject], objects: Objects, start: Layout) -> Layout:
    """Starts in which each object stands as its next hypothesis says.

    An object keeps its own shape, and gets the place, front and size of the hypothesis; one with
    fewer hypotheses than others stays at its start in the rest.

    Args:
        others: Hypotheses; the id of each is that of its object. Those of unknown objects are left
            out.
        objects: The furniture.
        start: Where the objects stand in the scene.

    Returns:
        As many starts as the object with most hypotheses has; none without hypotheses.
    """
    index = {name: i for i, name in enumerate(objects.ids)}
    ranks = dict.fromkeys(objects.ids, 0)
    found: list[tuple[int, int, SceneObject]] = []
    for piece in others:
        if piece.id in index:
            found.append((ranks[piece.id], index[piece.id], piece))
            ranks[piece.id] += 1
    count = max(ranks.values(), default=0)
    place = start.t_world_object.repeat(count, 1, 1)
    yaw, sizes = start.yaw.repeat(count, 1), start.log_scale.repeat(count, 1, 1)
    for rank, k, piece in found:
        box = box_of(piece)
        half = torch.stack([torch.zeros(()), box.size[1] / 2, torch.zeros(())])
        place[rank, k] = (box.center - half).to(place)
        yaw[rank, k] = piece.yaw.to(yaw)
        sizes[rank, k] = (box.size.to(sizes) / objects.size[k]).log()
    return Layout(place, yaw, sizes)


def contact_start(layout: Layout, objects: Objects, touches: ContactPoints | None) -> Layout:
    """Candidates of all objects: what is rested on, under its people and facing as they do."""
    if touches is None:
        return layout
    t, yaw = layout.t_world_object.clone(), layout.yaw.clone()
    for k, i in enumerate(touches.object_of.tolist()):
        x, z = touches.heading[k].unbind()
        weight = touches.weight[k, 0]
        if (
            not bool(objects.is_seat[i])
            or float(weight.sum()) == 0
            or float(x.abs() + z.abs()) == 0
        ):
            continue
        yaw[i] = torch.atan2(x, z)
        contact = (touches.points[k, 0] * weight.unsqueeze(-1)).sum(0) / weight.sum()
        seat = rot_y(yaw[i]) @ (objects.top[i].mean(0) * layout.log_scale[i].exp())
        t[i] = torch.stack([contact[0] - seat[0], t[i, 1], contact[2] - seat[2]])
    return Layout(t, yaw, layout.log_scale)
