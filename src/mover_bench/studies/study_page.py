"""Tables of a study as Markdown and as CSV."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from mover_bench.studies.compare import (
    COLUMNS,
    FEWEST,
    RESAMPLES,
    Cell,
    Filled,
    Interval,
    Row,
    head_of,
    markdown,
    shown,
)
from mover_bench.studies.finished import Source
from mover_bench.studies.job import ROOM, Job
from mover_bench.studies.queue import FAILED, failure_of, has_results
from mover_bench.studies.tables import write_csv

MARKS = {"better": " ▲", "worse": " ▼", "": ""}
LEGEND = (
    f"▲ significantly better, ▼ worse than {{against}}: paired bootstrap over rooms ({RESAMPLES:,}"
    " resamples), 5 % over all comparisons of this page by Holm's correction, from"
    f" {FEWEST} rooms on."
)
FIELDS: tuple[str, ...] = (
    "table", "row", "quoted", "metric", "unit", "rooms", "mean", "low", "high",
    "difference", "difference_low", "difference_high", "p", "p_holm", "mark", "command",
)  # fmt: skip


def table_of(filled: Filled) -> str:
    """A table with its marks, and the differences below it."""
    table = filled.table
    parts = [f"## {table.title}"] + ([table.note] if table.note else [])
    head = ["", *table.parts, *(head_of(name) for name in table.columns), "rooms"]
    parts.append(markdown(head, [_row(filled, k) for k in range(len(table.rows))]))
    against = _against(filled)
    if against:
        parts += [
            LEGEND.format(against=f"*{against}*"),
            f"Difference from *{against}* with its 95 % interval:",
            _differences(filled),
        ]
    return "\n\n".join(parts)


def missing_of(jobs: Sequence[Job]) -> list[str]:
    """What failed or was not run, so that nothing is left out silently."""
    without = [job for job in jobs if not has_results(job)]
    failed = [job for job in without if (job.folder / FAILED).exists()]
    lines = [
        f"**Failed**: {job.rooms} {job.seed}, {job.name}: {failure_of(job).reason}"
        for job in failed
    ]
    if len(without) > len(failed):
        count = f"{len(without) - len(failed):,} of {len(jobs):,}"
        lines.append(f"**Not run**: {count} jobs; the tables hold what is finished.")
    return lines


def _row(filled: Filled, index: int) -> list[str]:
    row, cells = filled.table.rows[index], filled.cells[index]
    ticks = ["✓" if on else "" for on in row.ticks] or [""] * len(filled.table.parts)
    label = f"*{row.label}* (paper)" if row.source is None else row.label
    return [label, *ticks, *(_shown(cell) for cell in cells), _rooms(cells)]


def _shown(cell: Cell) -> str:
    if cell.value is None:
        return shown(cell.metric, cell.quoted)
    return shown(cell.metric, cell.value.mean) + MARKS[cell.mark]


def _rooms(cells: Sequence[Cell]) -> str:
    counts = sorted({cell.value.rooms for cell in cells if cell.value is not None})
    return "-".join(str(n) for n in dict.fromkeys((*counts[:1], *counts[-1:])))


def _against(filled: Filled) -> str:
    """Label of the row that the others are compared with."""
    source = filled.table.against
    labels = [row.label for row in filled.table.rows if row.source == source]
    return labels[0] if source is not None and labels else ""


def _differences(filled: Filled) -> str:
    rows = [
        [row.label, *(_interval(cell) for cell in cells)]
        for row, cells in zip(filled.table.rows, filled.cells, strict=True)
        if any(cell.difference is not None for cell in cells)
    ]
    return markdown(["", *(head_of(name) for name in filled.table.columns)], rows)


def _interval(cell: Cell) -> str:
    return "-" if cell.difference is None else difference_text(cell.metric, cell.difference)


def difference_text(metric: str, found: Interval) -> str:
    """A difference and its interval in the unit of the column."""
    mean, low, high = (shown(metric, v, sign=True) for v in (found.mean, found.low, found.high))
    return f"{mean} [{low}, {high}]"


def command_of(source: Source, seeds: str) -> str:
    """The command that does the jobs of a row."""
    names = " ".join("robust" if name == ROOM else name for name in source.names)
    return f"mover experiment --set {source.rooms} --seeds {seeds} --presets {names}"


def commands_of(tables: Sequence[Filled], seeds: Mapping[str, str]) -> list[str]:
    """The commands of all rows, each once."""
    sources = [row.source for filled in tables for row in filled.table.rows if row.source]
    return list(dict.fromkeys(command_of(s, seeds[s.rooms]) for s in sources))


def write_numbers(tables: Sequence[Filled], seeds: Mapping[str, str], path: Path) -> None:
    """A line for each number [m], [rad]: mean, interval, difference, p, and its command."""
    from pandas import DataFrame

    lines = [
        _line(filled.table.title, row, cell, seeds)
        for filled in tables
        for row, cells in zip(filled.table.rows, filled.cells, strict=True)
        for cell in cells
    ]
    write_csv(DataFrame(lines), FIELDS, path)


def _line(title: str, row: Row, cell: Cell, seeds: Mapping[str, str]) -> dict[str, str]:
    value, difference = cell.value, cell.difference
    line: dict[str, str] = {
        "table": title,
        "row": row.label,
        "quoted": "yes" if row.source is None else "",
        "metric": cell.metric,
        "unit": "m" if COLUMNS[cell.metric].factor in (100, 1000) else "",
        "mark": cell.mark,
        "command": "" if row.source is None else command_of(row.source, seeds[row.source.rooms]),
    }
    if COLUMNS[cell.metric].unit == "°":
        line["unit"] = "rad"
    if cell.quoted is not None:
        line["mean"] = f"{cell.quoted:.6g}"
    if value is not None:
        line |= {"rooms": str(value.rooms), **_three("mean", "low", "high", value)}
    if difference is not None:
        names = ("difference", "difference_low", "difference_high")
        line |= _three(*names, difference)
        line |= {"p": f"{difference.p:.4g}", "p_holm": f"{cell.adjusted:.4g}"}
    return line


def _three(mean: str, low: str, high: str, found: Interval) -> dict[str, str]:
    return {mean: f"{found.mean:.6g}", low: f"{found.low:.6g}", high: f"{found.high:.6g}"}
