r"""People move smoothly, and errors last (Sec. 3.2, E_smooth of the batch-wise bodies).

Evidence:  rows of one track at most a second apart.
Price:     smooth: rho(x(t) between its neighbours in time), x the joints and the pelvis, rho
           Geman-McClure; the size of an honest residual grows with the time between the frames.
           steady: change between two frames of what was changed: an error of pose or depth does
           not come and go. lock: way of a sole at rest between two frames.
Paper:     second differences of joints and of their pixels at the video's rate, whatever it is.
"""

from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.minimize import geman_mcclure, safe_norm

GAP = 1.0  # [s], longer nothing is known about the way between two frames
TREMBLE = 0.02  # [m], second difference of a body that is fitted frame by frame
PUSH = 1.5  # [m/s²], usual acceleration of a joint
TAIL = 3.0  # usual residuals at which the price is half of the most
ANGLE = 0.09  # [rad], usual error of a joint
ANGLE_LASTS = 0.6  # [s]
DEPTH = 0.015  # usual error of the depth that changes with time, as a share
DEPTH_LASTS = 1.0  # [s]
FRESH = 0.003  # share of the depth's error that is new in each frame
SLIP = 0.02  # [m], usual way of a sole at rest in a fit
POINTS = 8.0  # joints whose ways are independent, of all of them


@record
class Neighbours:
    """Which rows follow each other in time."""

    triples: Int[Tensor, "triples 3"]
    """Rows before, at and after a moment."""
    steps: Float[Tensor, "triples 2"]
    """Time from the first to the second and to the third [s]."""
    pairs: Int[Tensor, "pairs 2"]
    """Rows that follow each other."""
    gaps: Float[Tensor, " pairs"]
    """Time between them [s]."""
    track: Int[Tensor, " rows"]
    """Number of each row's person, from 0."""


def gather_neighbours(
    frame: Int[Tensor, " bodies"], person: Int[Tensor, " bodies"], fps: float | None
) -> Neighbours:
    """Rows of the same track that follow each other within a second; none of unordered images."""
    count = len(frame)
    order = sorted(range(count), key=lambda k: (int(person[k]), int(frame[k])))
    pairs: list[tuple[int, int]] = []
    gaps: list[float] = []
    for a, b in pairwise(order):
        gap = float(frame[b] - frame[a]) / (fps or 1.0)
        if fps is not None and person[a] == person[b] and 0 < gap <= GAP:
            pairs.append((a, b))
            gaps.append(gap)
    after = dict(zip(pairs, gaps, strict=True))
    follows = dict(pairs)
    triples = [(a, b, follows[b]) for a, b in pairs if b in follows]
    steps = [(after[a, b], after[b, c]) for a, b, c in triples]
    return Neighbours(
        torch.tensor(triples, dtype=torch.long).reshape(-1, 3),
        torch.tensor(steps).reshape(-1, 2),
        torch.tensor(pairs, dtype=torch.long).reshape(-1, 2),
        torch.tensor(gaps),
        person.unique(return_inverse=True)[1],
    )


def smooth_term(
    points: Float[Tensor, "bodies points 3"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Price of points that are off the straight way between their neighbours in time [nats]."""
    i, j, k = near.triples.unbind(-1)
    before, after = near.steps.to(points).unbind(-1)
    to_i, to_k = (after / (before + after)), (before / (before + after))
    straight = points[i] * to_i[:, None, None] + points[k] * to_k[:, None, None]
    off = 2 * safe_norm(points[j] - straight)
    usual = (TREMBLE + PUSH * before * after)[:, None]
    price = 0.5 * POINTS * TAIL**2 * geman_mcclure(off / usual, TAIL).mean(-1)
    return _per_row(price, j, len(near.track))


def steady_term(
    angles: Float[Tensor, "bodies angles"], share: Float[Tensor, " bodies"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Price of changes of angles [rad] and of depth that come and go [nats]."""
    i, j = near.pairs.unbind(-1)
    gaps = near.gaps.to(angles)
    turned = (angles[j] - angles[i]).square().sum(-1) / (ANGLE**2 * _fresh(gaps, ANGLE_LASTS))
    moved = (share[j] - share[i]).square()
    moved = moved / (DEPTH**2 * _fresh(gaps, DEPTH_LASTS) + FRESH**2)
    return _per_row(0.5 * (turned + moved), j, len(near.track))


def lock_term(
    soles: Float[Tensor, "bodies feet 3"], rest: Float[Tensor, "bodies feet"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Price of soles at rest (a chance) that slide between rows that follow each other [nats]."""
    i, j = near.pairs.unbind(-1)
    slip = geman_mcclure(safe_norm(soles[j] - soles[i]) / SLIP, TAIL)
    both = rest[i] * rest[j]
    return _per_row(0.5 * TAIL**2 * (both * slip).sum(-1), j, len(near.track))


def _fresh(gaps: Float[Tensor, " pairs"], lasts: float) -> Float[Tensor, " pairs"]:
    """Variance of what is new after so long, of an error of variance one."""
    return 2 * (1 - (-gaps / lasts).exp())


def _per_row(price: Float[Tensor, " items"], row: Int[Tensor, " items"], rows: int) -> Tensor:
    return price.new_zeros(rows).index_add(0, row, price)
