"""Rows of the same person in the order of time."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .config import FitConfig
from .energy import Triples


def tracks_of(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"]
) -> list[Int[Tensor, " track"]]:
    """Rows of each person, in the order of their frames."""
    found: list[Tensor] = []
    for one in person.unique().tolist():
        rows = torch.nonzero(person == one)[:, 0]
        found.append(rows[torch.argsort(frame[rows], stable=True)])
    return found


def triples_of(
    frame: Int[Tensor, " rows"],
    person: Int[Tensor, " rows"],
    fps: float | None,
    config: FitConfig,
) -> Triples:
    """Neighbours in time of each person; none of unordered images and across long gaps."""
    none = torch.zeros(0, 3, dtype=torch.long)
    if fps is None:
        return Triples(none, torch.zeros(0), torch.zeros(0))
    found = [none]
    for rows in tracks_of(frame, person):
        found.append(torch.stack([rows[:-2], rows[1:-1], rows[2:]], 1))
    triples = torch.cat(found)
    time = frame[triples].double() / fps
    before, after = time[:, 1] - time[:, 0], time[:, 2] - time[:, 1]
    near = torch.maximum(before, after) <= config.longest_gap
    triples, before, after = triples[near], before[near], after[near]
    share = (after / (before + after)).float()
    expected = config.jitter + config.acceleration * before * after
    return Triples(triples, share, expected.float())


def every_so_often(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"], step: int
) -> tuple[Int[Tensor, " some"], Int[Tensor, " rows"]]:
    """Every so many rows of each track, and which of those is the nearest for each row."""
    picked: list[Tensor] = []
    nearest = torch.zeros(len(frame), dtype=torch.long)
    count = 0
    for rows in tracks_of(frame, person):
        some = rows[torch.arange(min(step // 2, len(rows) - 1), len(rows), step)]
        way = (frame[rows][:, None] - frame[some][None]).abs()
        nearest[rows] = count + way.argmin(1)
        picked.append(some)
        count += len(some)
    return torch.cat(picked), nearest


def best_path(
    cost: Float[Tensor, "rows options"], step: Float[Tensor, "steps options options"]
) -> Int[Tensor, " rows"]:
    """The option of each row with the least sum of costs and steps (Viterbi)."""
    total, came = cost[0], list[Tensor]()
    for k in range(1, len(cost)):
        least, origin = (total[:, None] + step[k - 1]).min(0)
        came.append(origin)
        total = least + cost[k]
    path = [int(total.argmin())]
    for origin in reversed(came):
        path.append(int(origin[path[-1]]))
    return torch.tensor(path[::-1])
