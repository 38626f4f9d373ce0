"""Distances between points of moving objects and of the world, with gradients in closed form."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from .kernels.start import kernels, launch, name_of, started
from .nearest_warp import Clouds
from .raster_engine import threads
from .raster_warp_cpu import share


@dataclass(frozen=True)
class FromWorld:
    """The weighted distances from points of the world to the nearest point of an object, summed.

    Neighbours that follow one another are found sooner.
    """

    points: Float[Tensor, "asked points 3"]
    """[m]."""
    weight: Float[Tensor, "asked points"]
    """0 leaves a point out."""
    to: Clouds
    """Of all objects, in their own axes."""


@dataclass(frozen=True)
class FromObject:
    """The mean distance from the points of an object to the nearest point of the world."""

    points: Clouds
    """Of all objects, in their own axes."""
    to: Clouds
    """Points of the world for each object [m]."""
    asks: Bool[Tensor, " asked"]
    """Whether there are any."""


Way = FromWorld | FromObject


def reach(
    pose: Float[Tensor, "*starts asked 7"], item: Int[Tensor, " asked"], ways: tuple[Way, ...]
) -> Float[Tensor, "*starts asked"]:
    """Sum of distances of objects [m]; the pairing is constant; differentiable once.

    Args:
        pose: Place [m], yaw [rad] and logarithms of the scale.
        item: Which object is asked for.
        ways: What is summed.
    """
    price = _Reach.apply(pose, item, ways)
    assert isinstance(price, Tensor)
    return price


class _Reach(torch.autograd.Function):
    """Keeps the change with the pose."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        pose: Tensor,
        item: Tensor,
        ways: tuple[Way, ...],
    ) -> Tensor:
        rows = pose.detach().reshape(-1, 7).contiguous()
        price, slope = rows.new_zeros(len(rows)), torch.zeros_like(rows)
        if len(rows):
            for way in ways:
                _launch(rows, item, way, (price, slope))
        ctx.save_for_backward(slope.view(pose.shape))
        return price.view(pose.shape[:-1])

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None, None]:
        (slope,) = ctx.saved_tensors
        return slope * grads[0].unsqueeze(-1), None, None


def _launch(rows: Tensor, item: Tensor, way: Way, outputs: tuple[Tensor, Tensor]) -> None:
    """Add one way, on a CPU by a share of the rows in each thread."""
    wp = started()
    module = kernels("reach", name_of(rows.device))
    asked, cloud = _asked(module, rows, item, way), _cloud(way.to)
    slope = wp.from_torch(outputs[1], dtype=module.Slope)
    arrays = [wp.from_torch(outputs[0]), slope]
    kernel, inputs = module.from_world, [asked, cloud]
    if isinstance(way, FromObject):
        kernel, inputs = module.from_object, [asked, _points(way.points.points), cloud]
    parts = min(threads(), len(rows)) if rows.device.type == "cpu" else 1
    cuts = [len(rows) * k // parts for k in range(parts + 1)]

    def one(part: int) -> None:
        size = cuts[part + 1] - cuts[part]
        launch(kernel, size, [*inputs, cuts[part], *arrays], rows.device)

    share(one, parts)


def _asked(module: Any, rows: Tensor, item: Tensor, way: Way) -> Any:  # noqa: ANN401
    """`kernels.reach.Asked`."""
    wp = started()
    asked = module.Asked()
    asked.pose = wp.from_torch(rows, dtype=module.Slope)
    asked.item = wp.from_torch(item.contiguous())
    if isinstance(way, FromWorld):
        number = torch.arange(1, way.weight.shape[1] + 1, device=rows.device)
        stop = ((way.weight > 0) * number).amax(-1)
        asked.points = _points(way.points)
        asked.weight = wp.from_torch(way.weight.detach().contiguous())
    else:
        stop = way.asks
    asked.first = wp.from_torch(torch.zeros_like(item, dtype=torch.int32))
    asked.stop = wp.from_torch(stop.to(torch.int32).contiguous())
    return asked


def _cloud(held: Clouds) -> Any:  # noqa: ANN401
    """`kernels.nearest.Cloud`."""
    from .kernels.nearest import Cloud

    cloud = Cloud()
    cloud.points = _points(held.points)
    cloud.index = started().from_torch(held.index.contiguous())
    for name, boxes in (("leaf", held.leaves), ("group", held.groups)):
        for side, corner in enumerate(("low", "high")):
            setattr(cloud, f"{name}_{corner}", _points(boxes[:, side]))
    return cloud


def _points(points: Tensor) -> Any:  # noqa: ANN401
    wp = started()
    return wp.from_torch(points.detach().contiguous(), dtype=wp.vec3)
