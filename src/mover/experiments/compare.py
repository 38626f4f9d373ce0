"""Tables whose rows are compared with one of them, room by room."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

from .columns import COLUMNS
from .finished import Finished, Source, by_room
from .statistics import Interval, holm, interval, is_significant, paired_rooms

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
