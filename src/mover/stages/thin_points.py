"""Thin clouds of points out to cells, so that their number does not grow with the video."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

GOLDEN = 0.6180339887498949  # its multiples, modulo 1, fill the unit interval evenly


def thin(
    points: Float[Tensor, "points 3"],
    group: Int[Tensor, " points"],
    groups: int,
    limits: tuple[float, int],
) -> tuple[Float[Tensor, "groups most 3"], Float[Tensor, "groups most"]]:
    """One point, their mean, for all points of a group in one cell; and how many they were.

    Args:
        points: All points [m].
        group: Group of each point.
        groups: Number of groups.
        limits: Edge of a cell [m], and the number of points of a group that are kept at most:
            where there are more cells, evenly chosen ones stand for all.
    """
    cell, most = limits
    key = torch.cat([group.unsqueeze(-1), (points / cell).floor().long()], -1)
    cells, owner, count = key.unique(dim=0, return_inverse=True, return_counts=True)
    means = torch.zeros(len(cells), 3, dtype=points.dtype).index_add(0, owner, points)
    means = means / count.unsqueeze(-1)
    rows: list[tuple[Tensor, Tensor]] = []
    for g in range(groups):
        mine = (cells[:, 0] == g).nonzero()[:, 0]
        kept = evenly(mine, most)
        total = count[mine].sum().to(points)
        share = count[kept].to(points)
        rows.append((means[kept], share * (total / share.sum().clamp_min(1))))
    longest = max(1, max(len(p) for p, _ in rows))
    padded = [torch.nn.functional.pad(p, (0, 0, 0, longest - len(p))) for p, _ in rows]
    weight = [torch.nn.functional.pad(w, (0, longest - len(w))) for _, w in rows]
    return torch.stack(padded), torch.stack(weight)


def evenly(rows: Int[Tensor, " rows"], most: int) -> Int[Tensor, " some"]:
    """At most so many of them, evenly spread, the first and the last among them."""
    return rows[torch.linspace(0, len(rows) - 1, min(most, len(rows))).round().long()]


def in_turns(count: int) -> Int[Tensor, " count"]:
    """An order of so many rows whose beginnings are all spread evenly (golden ratio)."""
    return (torch.arange(count, dtype=torch.float64) * GOLDEN % 1).argsort()
