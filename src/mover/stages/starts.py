"""Several starts of the descent: spread, thin out, choose."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.rotations import wrap
from ..records import to_device
from ..terms.contact import Touches
from ..types import Layout

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
    tie: float,
) -> Layout:
    """The best start of each object.

    Tables and cabinets look alike when turned, so a turn away from the reference yaw counts:
    candidates rank by (E + 0.01) (1 + tie (1 - cos d) / 2), relative so that wrong shapes, whose
    energy is high, are not turned for a small gain.
    """
    turned = 1 - (layout.yaw - reference).cos()
    rank = (energy + 0.01) * (1 + tie * turned / 2)
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
    initial: Float[Tensor, " objects"], touches: Touches | None
) -> Float[Tensor, " objects"]:
    """Yaw of the sitters of used seats, else the initial one [rad]."""
    yaw = initial.clone()
    if touches is not None:
        x, z = touches.heading.unbind(-1)
        seated = (x.abs() + z.abs()) > 0
        yaw[touches.object_of[seated]] = torch.atan2(x, z)[seated]
    return yaw
