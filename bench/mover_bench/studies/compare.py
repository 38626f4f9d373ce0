"""Tables whose rows are compared with one of them, room by room.

A difference is told from none by a paired bootstrap over rooms, corrected by Holm.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from mover_bench.studies.finished import Finished, Frame, Source, by_room


@dataclass(frozen=True)
class Column:
    """How a metric is shown."""

    title: str
    better: int = 1
    """1: larger is better, -1: smaller, 0: neither (it is compared with the truth's own)."""
    unit: str = ""
    factor: float = 1.0
    """From metres, radians or shares to the unit."""
    digits: int = 3


DEGREES = 57.29577951308232
COLUMNS: dict[str, Column] = {
    "iou3d": Column("IoU3D"),
    "p2s": Column("P2S", -1, "cm", 100, 1),
    "iou2d": Column("IoU2D"),
    "non_collision": Column("Non-Col"),
    "contact": Column("Cont.", 0),
    "contact_f1": Column("contact F1"),
    "yaw_error": Column("yaw", -1, "°", DEGREES, 1),
    "yaw_error_symmetric": Column("yaw, alike sides aside", -1, "°", DEGREES, 1),
    "center_error": Column("centre", -1, "cm", 100, 1),
    "size_error": Column("size", -1, "cm", 100, 1),
    "worse_by_10cm": Column("worse by > 10 cm", -1, "%", 100, 1),
    "worse_by_50cm": Column("worse by > 50 cm", -1, "%", 100, 1),
    "iou3d_aligned": Column("IoU3D aligned"),
    "iou3d_touched": Column("IoU3D touched"),
    "iou3d_untouched": Column("IoU3D untouched"),
    "pitch_error": Column("pitch", -1, "°", DEGREES, 2),
    "roll_error": Column("roll", -1, "°", DEGREES, 2),
    "tilt": Column("mean", -1, "°", DEGREES, 2),
    "ground_error": Column("floor", -1, "cm", 100, 1),
    "ground_penetration_frequency": Column("Ground Pen. Freq.", -1),
    "ground_penetration_distance": Column("Ground Pen. Dist.", -1, "cm", 100, 1),
    "pje": Column("PJE", -1, "mm", 1000, 1),
    "v2v": Column("V2V", -1, "mm", 1000, 1),
    "p_pje": Column("p.PJE", -1, "mm", 1000, 1),
    "p_v2v": Column("p.V2V", -1, "mm", 1000, 1),
    "foot_skate": Column("skate", -1, "cm/s", 100, 1),
    "float_height": Column("float", -1, "mm", 1000, 1),
    "sink_depth": Column("sink", -1, "mm", 1000, 1),
    "penetration_depth": Column("in furniture", -1, "mm", 1000, 1),
    "jerk": Column("jerk", -1, "m/s³", 1, 1),
    "acceleration_error": Column("acceleration", -1, "m/s²", 1, 2),
    "stands": Column("stays", 1, "%", 100, 1),
    "moved": Column("moved", -1, "mm", 1000, 1),
    "turned": Column("turned", -1, "°", DEGREES, 2),
    "toppled": Column("fell over", -1, "%", 100, 1),
}
ARROWS = {1: " ↑", -1: " ↓", 0: ""}


def head_of(metric: str, columns: Mapping[str, Column] = COLUMNS) -> str:
    """Head of a column: name, unit, and the better side."""
    column = columns[metric]
    unit = f" [{column.unit}]" if column.unit else ""
    return f"{column.title}{unit}{ARROWS[column.better]}"


def shown(
    metric: str,
    value: float | None,
    columns: Mapping[str, Column] = COLUMNS,
    *,
    sign: bool = False,
) -> str:
    """A value in the unit of its column; `-` where there is none."""
    if value is None or math.isnan(value):
        return "-"
    column = columns[metric]
    rounded = round(column.factor * value, column.digits) + 0.0  # no negative zero
    return f"{rounded:{'+' if sign else ''}.{column.digits}f}"


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table: the first column on the left, the others on the right."""
    rule = ["---", *["--:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))


# Whether a row of a table differs from another.


RESAMPLES = 10_000
LEVEL = 0.95
MARKS = ("better", "worse")
Numbers = Any
"""A number, or a `pandas.Series` of numbers."""
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

    Equal seeds and room counts draw the same rooms.

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


def is_significant(rooms: Numbers, adjusted: Numbers) -> Any:  # noqa: ANN401
    """Whether differences are told from none: 5 % over the whole family, and enough rooms."""
    return (adjusted < 1 - LEVEL) & (rooms >= FEWEST)


# The tables themselves: what they ask for, and their numbers.


@dataclass(frozen=True)
class Row:
    """A row of a table: our jobs, or numbers that the paper prints."""

    label: str
    source: Source | None = None
    """None: quoted."""
    ticks: tuple[bool, ...] = ()
    """Which parts are on."""
    quoted: Mapping[str, float] = field(default_factory=dict[str, float])
    """Numbers of the paper [m], [rad]."""
    tested: bool = True
    """Whether the row is compared; the truth and the initial scene are not."""


@dataclass(frozen=True)
class Table:
    """What a table asks for."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    against: Source | None = None
    """What the rows are compared with; None: nothing."""
    parts: tuple[str, ...] = ()
    """Heads of the ticks."""
    note: str = ""


@dataclass(frozen=True)
class Filled:
    """A table with its numbers."""

    table: Table
    numbers: Frame
    """A line for each row (`place`, its index) and metric: `NUMBERS`, empty where there is none."""


NUMBERS = (
    "place", "metric", "rooms", "mean", "low", "high", "shared", "difference", "difference_low",
    "difference_high", "p", "p_holm", "mark",
)  # fmt: skip
"""Mean over the rooms [m], [rad], its interval; the same of the difference in `shared` rooms."""


def fill_tables(
    tables: Sequence[Table], finished: Finished, seeds: Mapping[str, Sequence[int]]
) -> list[Filled]:
    """Fill in all tables of a study; its comparisons are one family for Holm's correction."""
    from pandas import DataFrame

    lines = [
        {"table": t, "place": r, "metric": metric} | _numbers(metric, table, row, finished, seeds)
        for t, table in enumerate(tables)
        for r, row in enumerate(table.rows)
        for metric in table.columns
    ]
    found = DataFrame(lines, columns=["table", *NUMBERS])
    better = found.metric.map(lambda name: COLUMNS[name].better)
    tested = found.p.notna() & (better != 0)
    found["p_holm"] = found.p.where(found.p.isna(), 1.0)
    found.loc[tested, "p_holm"] = holm(found.p[tested].tolist())
    told = tested & is_significant(found.shared, found.p_holm)
    found["mark"] = np.select([told & (found.difference * better > 0), told], MARKS, "")
    return [Filled(table, found[found.table == t]) for t, table in enumerate(tables)]


def _numbers(
    metric: str, table: Table, row: Row, finished: Finished, seeds: Mapping[str, Sequence[int]]
) -> dict[str, float | None]:
    if row.source is None:
        return {"mean": row.quoted.get(metric)}
    values, other = by_room(finished, row.source, metric, seeds[row.source.rooms]), table.against
    line: dict[str, float | None] = {}
    if values:
        own = interval(list(values.values()))
        line |= {"rooms": own.rooms, "mean": own.mean, "low": own.low, "high": own.high}
    if other is None or not row.tested or other == row.source:
        return line
    gap = paired_rooms(values, by_room(finished, other, metric, seeds[other.rooms]))
    if gap is not None:
        line |= {"difference": gap.mean, "difference_low": gap.low, "difference_high": gap.high}
        line |= {"shared": gap.rooms, "p": gap.p}
    return line
