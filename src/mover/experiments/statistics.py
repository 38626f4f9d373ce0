"""Whether a row of a table differs from another: paired bootstrap over rooms, corrected by Holm."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

RESAMPLES = 10_000
LEVEL = 0.95
FEWEST = 6
"""With fewer rooms no difference can be significant: even if all rooms agree, 2 / 2^5 > .05."""


@dataclass(frozen=True)
class Interval:
    """A mean over rooms and what the draw of the rooms leaves open."""

    mean: float
    low: float
    """Lower end of the 95 % interval (percentiles of the resampled means)."""
    high: float
    p: float
    """Two-sided chance of such a mean if it were zero."""
    rooms: int


def paired(
    values: Sequence[float], reference: Sequence[float], seed: int = 0, resamples: int = RESAMPLES
) -> Interval:
    """Mean of `values - reference` over the same rooms.

    Args:
        values: One for each room.
        reference: The same metric of the row that is compared with, room by room.
        seed: Of the resampling; equal seeds and room counts draw the same rooms.
        resamples: How often rooms are drawn anew, with replacement.

    Raises:
        ValueError: If the two are of different length or empty.
    """
    if len(values) != len(reference) or not values:
        raise ValueError(f"{len(values)} and {len(reference)} rooms, expected as many, at least 1")
    return interval(np.subtract(values, reference), seed, resamples)


def paired_rooms(values: Mapping[int, float], reference: Mapping[int, float]) -> Interval | None:
    """The same for values by room, in the rooms that both have; None: they share none."""
    both = [room for room in values if room in reference]
    return paired([values[r] for r in both], [reference[r] for r in both]) if both else None


def interval(
    values: Sequence[float] | Float[np.ndarray, " rooms"],
    seed: int = 0,
    resamples: int = RESAMPLES,
) -> Interval:
    """Mean of some values, its percentile interval, and p of the studentised bootstrap.

    p counts the resamples whose mean is as many of their own standard errors away from the mean as
    the mean is from zero, and the sample itself. Shares of resampled means beyond zero would be
    simpler, but they claim too much: where all of six rooms agree by chance (3 %), every resample
    does. For the same reason p is at least the chance that all rooms agree, 2 / 2^rooms.
    """
    data = np.asarray(values, dtype=np.float64)
    count, mean = len(data), float(np.mean(values))
    drawn = data[np.random.default_rng(seed).integers(0, count, (resamples, count))]
    means, spreads = drawn.mean(1), drawn.std(1)
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    beyond = np.abs(means - mean) * data.std() >= abs(mean) * spreads * (1 - 1e-9)
    same = data.std() <= 1e-12 * abs(mean) and mean != 0  # every room says exactly this
    p = ((0 if same else int(beyond.sum())) + 1) / (resamples + 1)
    return Interval(mean, float(low), float(high), min(1.0, max(p, 2.0 / 2**count)), count)


def holm(chances: Sequence[float]) -> list[float]:
    """Adjusted p-values of a family of comparisons, in the order given.

    The k-th smallest of m is multiplied by m - k + 1, never below the one before it, at most 1
    (Holm 1979): the chance of a single false claim in the whole family stays below the level.
    """
    order = sorted(range(len(chances)), key=lambda k: chances[k])
    adjusted, least = [0.0] * len(chances), 0.0
    for place, index in enumerate(order):
        least = max(least, min(1.0, (len(order) - place) * chances[index]))
        adjusted[index] = least
    return adjusted


def is_significant(found: Interval, adjusted: float) -> bool:
    """Whether a difference is told from none: 5 % over the whole family, and enough rooms."""
    return adjusted < 1 - LEVEL and found.rooms >= FEWEST
