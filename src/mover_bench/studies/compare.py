"""Tables whose rows are compared with one of them, room by room.

A difference is told from none by a paired bootstrap over rooms, corrected by Holm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Float

from mover_bench.studies.finished import Finished, Source, by_room


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
    if value is None:
        return "-"
    column = columns[metric]
    rounded = round(column.factor * value, column.digits) + 0.0  # no negative zero
    return f"{rounded:{'+' if sign else ''}.{column.digits}f}"


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table: the first column on the left, the others on the right."""
    rule = ["---", *["--:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))


# Whether a row of a table differs from another: paired bootstrap over rooms, corrected by Holm.


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


# Tables whose rows are compared with one of them, room by room.


T = TypeVar("T")
Mark = Literal["better", "worse", ""]


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
class Cell:
    """A number of a table."""

    metric: str
    value: Interval | None
    """Over the rooms; None: missing, or quoted."""
    difference: Interval | None = None
    """From the row that it is compared with, over the rooms that both have."""
    adjusted: float = 1.0
    """p of the difference after Holm's correction over the study."""
    quoted: float | None = None

    @property
    def mark(self) -> Mark:
        """Whether the difference is told from none, and to which side."""
        found, side = self.difference, COLUMNS[self.metric].better
        if found is None or not side or not is_significant(found, self.adjusted):
            return ""
        return "better" if found.mean * side > 0 else "worse"


@dataclass(frozen=True)
class Filled:
    """A table with its numbers: one list of cells for each row."""

    table: Table
    cells: tuple[tuple[Cell, ...], ...]


def fill_tables(
    tables: Sequence[Table], finished: Finished, seeds: Mapping[str, Sequence[int]]
) -> list[Filled]:
    """Fill in all tables of a study; its comparisons are one family for Holm's correction.

    Args:
        tables: What is asked for.
        finished: What the jobs have left.
        seeds: The rooms of each set.
    """
    raw = [[_cells(table, row, finished, seeds) for row in table.rows] for table in tables]
    tested = [
        (t, r, c)
        for t, rows in enumerate(raw)
        for r, cells in enumerate(rows)
        for c, cell in enumerate(cells)
        if cell.difference is not None and COLUMNS[cell.metric].better
    ]
    chances = holm([_known(raw[t][r][c].difference).p for t, r, c in tested])
    for (t, r, c), adjusted in zip(tested, chances, strict=True):
        raw[t][r][c] = replace(raw[t][r][c], adjusted=adjusted)
    return [
        Filled(table, tuple(tuple(cells) for cells in rows))
        for table, rows in zip(tables, raw, strict=True)
    ]


def _cells(
    table: Table, row: Row, finished: Finished, seeds: Mapping[str, Sequence[int]]
) -> list[Cell]:
    if row.source is None:
        return [Cell(name, None, quoted=row.quoted.get(name)) for name in table.columns]
    return [_cell(name, table, row, finished, seeds) for name in table.columns]


def _cell(
    metric: str, table: Table, row: Row, finished: Finished, seeds: Mapping[str, Sequence[int]]
) -> Cell:
    source, other = _known(row.source), table.against
    values = by_room(finished, source, metric, seeds[source.rooms])
    mean = interval(list(values.values())) if values else None
    if other is None or not row.tested or other == source:
        return Cell(metric, mean)
    theirs = by_room(finished, other, metric, seeds[other.rooms])
    return Cell(metric, mean, paired_rooms(values, theirs))


def _known(value: T | None) -> T:
    assert value is not None
    return value
