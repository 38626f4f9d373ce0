"""Nearest points of objects that are scaled, turned and moved, from boxes that never change.

The distance from a world point q to an object's point x, placed by x -> R diag(s) x + t, is that
from R^T (q - t) to diag(s) x: boxes in the object's own frame, stretched by s, bound it exactly.
(Search trees of libraries would have to be built again for each size.)
"""

from math import prod
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.geometry.warp_start import array, filled, kernels, launch, name_of, share, threads

FAN = 16  # points of a box


@record
class Clouds:
    """Points of each object in its own frame, in the order of their boxes [m]."""

    points: Float[Tensor, "objects points 3"]
    index: Int[Tensor, "objects points"]
    """Where each was in the list that was given."""
    boxes: Float[Tensor, "objects 2 boxes 3"]
    """Lowest and highest corner of the box of each `FAN` points [m]."""


def clouds(points: Float[Tensor, "objects points 3"]) -> Clouds:
    """Order the points by halves, quarters, ... across the longest side.

    Raises:
        ValueError: If objects have no points.
    """
    if points.shape[1] == 0:
        raise ValueError("clouds: no points, expected at least one for each object")
    points, count = points.detach(), points.shape[1]
    index = torch.stack([_order(p) for p in points]) if len(points) else points.new_zeros(0, count)
    index = index.long()
    ordered = points.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
    parts = ordered.split(FAN, 1)
    lows, highs = (torch.stack([f(part, 1) for part in parts], 1) for f in (torch.amin, torch.amax))
    return Clouds(ordered, index, torch.stack([lows, highs], 1))


def _order(points: Tensor) -> Tensor:
    order, size = torch.arange(len(points), device=points.device), len(points)
    while size > FAN:  # whole boxes on either side
        size = max(-(-size // (2 * FAN)) * FAN, FAN)
        parts: list[Tensor] = []
        for part in order.split(2 * size):
            axis = int((points[part].amax(0) - points[part].amin(0)).argmax())
            parts.append(part[points[part, axis].argsort(stable=True)])
        order = torch.cat(parts)
    return order


def packed(held: Clouds) -> Any:  # noqa: ANN401
    """`kernels.nearest.Cloud` of the points."""
    from mover.geometry.kernels.nearest import Cloud

    low, high = (corner.float().contiguous() for corner in held.boxes.unbind(1))
    points = held.points.float().contiguous()
    return filled(Cloud, points=points, index=held.index.contiguous(), low=low, high=high)


def nearest(
    held: Clouds,
    query: Float[Tensor, "*starts objects queries 3"],
    scale: Float[Tensor, "*starts objects 3"],
) -> Int[Tensor, "*starts objects queries"]:
    """Index of the point of each object that is nearest to each query; no gradient.

    Queries are in the axes of each object, from its origin, not scaled [m].
    """
    kernel = kernels("nearest", name_of(query.device)).nearest
    rows = query.detach().float().reshape(prod(query.shape[:-2]), *query.shape[-2:]).contiguous()
    sizes = scale.detach().float().reshape(-1, 3).contiguous()
    found = torch.zeros(rows.shape[:2], dtype=torch.int64, device=rows.device)
    if found.numel():
        inputs = [packed(held), array(rows, "vec3"), array(sizes, "vec3"), array(found, "int64")]
        parts = min(threads(), len(rows)) if rows.device.type == "cpu" else 1
        cuts = [len(rows) * k // parts for k in range(parts + 1)]

        def find(part: int) -> None:
            size = (cuts[part + 1] - cuts[part], found.shape[1])
            launch(kernel, size, [*inputs, cuts[part]], rows.device)

        share(find, parts)
    return found.reshape(query.shape[:-1])
