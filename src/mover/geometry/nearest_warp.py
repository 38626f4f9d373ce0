"""Nearest points of objects that are scaled, turned and moved, from trees that never change.

The distance from a world point q to an object's point x, placed by x -> R diag(s) x + t, is that
from R^T (q - t) to diag(s) x: boxes in the object's own frame, stretched by s, bound it exactly.
"""

from math import prod
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.geometry.warp_start import filled, kernels, launch, name_of, share, started, threads

FAN = 8  # points of a leaf, leaves of a group


@record
class Clouds:
    """Points of each object in its own frame, in the order of their boxes [m]."""

    points: Float[Tensor, "objects points 3"]
    index: Int[Tensor, "objects points"]
    """Where each was in the list that was given."""
    leaves: Float[Tensor, "objects 2 leaves 3"]
    """Lowest and highest corner of each leaf [m]."""
    groups: Float[Tensor, "objects 2 groups 3"]
    """The same of each group of leaves [m]."""


def clouds(points: Float[Tensor, "objects points 3"]) -> Clouds:
    """Order the points by halves, quarters, ... across the longest side.

    Raises:
        ValueError: If objects have no points.
    """
    if points.shape[1] == 0:
        raise ValueError("clouds: no points, expected at least one for each object")
    points, count = points.detach(), points.shape[1]
    order = torch.stack([_order(p) for p in points]) if len(points) else points.new_zeros(0, count)
    index = order.long()
    ordered = points.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
    leaves = _boxes(ordered, ordered)
    return Clouds(ordered, index, leaves, _boxes(leaves[:, 0], leaves[:, 1]))


def _order(points: Tensor) -> Tensor:
    order, size = torch.arange(len(points), device=points.device), len(points)
    while size > FAN:  # whole leaves on either side, so that boxes and leaves agree
        size = max(-(-size // (2 * FAN)) * FAN, FAN)
        parts: list[Tensor] = []
        for part in order.split(2 * size):
            axis = int((points[part].amax(0) - points[part].amin(0)).argmax())
            parts.append(part[points[part, axis].argsort(stable=True)])
        order = torch.cat(parts)
    return order


def _boxes(low: Tensor, high: Tensor) -> Tensor:
    """Boxes of FAN neighbours at a time; the last may hold fewer."""
    lows = torch.stack([part.amin(1) for part in low.split(FAN, 1)], 1)
    highs = torch.stack([part.amax(1) for part in high.split(FAN, 1)], 1)
    return torch.stack([lows, highs], 1)


def packed(held: Clouds) -> Any:  # noqa: ANN401
    """`kernels.nearest.Cloud` of the points."""
    from mover.geometry.kernels.nearest import Cloud

    boxes: dict[str, Tensor] = {}
    for name, both in (("leaf", held.leaves), ("group", held.groups)):
        for corner, box in zip(("low", "high"), both.float().unbind(1), strict=True):
            boxes[f"{name}_{corner}"] = box.contiguous()
    return filled(
        Cloud, points=held.points.float().contiguous(), index=held.index.contiguous(), **boxes
    )


def nearest(
    held: Clouds,
    query: Float[Tensor, "*starts objects queries 3"],
    scale: Float[Tensor, "*starts objects 3"],
) -> Int[Tensor, "*starts objects queries"]:
    """Index of the point of each object that is nearest to each query; no gradient.

    Queries are in the axes of each object, from its origin, not scaled [m].
    """
    wp = started()
    kernels("nearest", name_of(query.device))
    from mover.geometry.kernels.nearest import nearest

    rows = query.detach().float().reshape(prod(query.shape[:-2]), *query.shape[-2:]).contiguous()
    sizes = scale.detach().float().reshape(-1, 3).contiguous()
    found = torch.zeros(rows.shape[:2], dtype=torch.int64, device=rows.device)
    if found.numel():
        cloud = packed(held)
        arrays = [wp.from_torch(rows, dtype=wp.vec3), wp.from_torch(sizes, dtype=wp.vec3)]
        arrays.append(wp.from_torch(found))
        parts = min(threads(), len(rows)) if rows.device.type == "cpu" else 1
        cuts = [len(rows) * k // parts for k in range(parts + 1)]

        def find(part: int) -> None:
            first, stop = cuts[part], cuts[part + 1]
            size = (stop - first, found.shape[1])
            launch(nearest, size, [cloud, *arrays, first], rows.device)

        share(find, parts)
    return found.reshape(query.shape[:-1])
