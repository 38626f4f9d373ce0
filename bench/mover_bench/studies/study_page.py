"""Tables of a study as Markdown and as CSV."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mover.core.colours import PALETTE, css
from mover_bench.studies.compare import (
    COLUMNS,
    FEWEST,
    RESAMPLES,
    Filled,
    head_of,
    markdown,
    paired_rooms,
    shown,
)
from mover_bench.studies.finished import Frame, Source
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
    table, heads = filled.table, [head_of(name) for name in filled.table.columns]
    parts = [f"## {table.title}"] + ([table.note] if table.note else [])
    rows, differences = list[list[str]](), list[list[str]]()
    for row, (_, cells) in zip(table.rows, filled.numbers.groupby("place"), strict=True):
        ticks = ["✓" if on else "" for on in row.ticks] or [""] * len(table.parts)
        label = f"*{row.label}* (paper)" if row.source is None else row.label
        marked = [shown(c.metric, c.mean) + MARKS[c.mark] for c in cells.itertuples()]
        rows.append([label, *ticks, *marked, _span(cells.rooms)])
        if cells.difference.notna().any():
            differences.append([row.label, *(_difference(c) for c in cells.itertuples())])
    parts.append(markdown(["", *table.parts, *heads, "rooms"], rows))
    against = [row.label for row in table.rows if table.against and row.source == table.against]
    if against:
        parts += [
            LEGEND.format(against=f"*{against[0]}*"),
            f"Difference from *{against[0]}* with its 95 % interval:",
            markdown(["", *heads], differences),
        ]
    return "\n\n".join(parts)


def missing_of(jobs: Sequence[Job]) -> list[str]:
    """What failed or was not run, so that nothing is left out silently."""
    without = [job for job in jobs if not has_results(job)]
    failed = [job for job in without if (job.folder / FAILED).exists()]
    lines = [f"**Failed**: {job.rooms} {job.seed}, {job.name}: {failure_of(job)}" for job in failed]
    if len(without) > len(failed):
        count = f"{len(without) - len(failed):,} of {len(jobs):,}"
        lines.append(f"**Not run**: {count} jobs; the tables hold what is finished.")
    return lines


def _span(rooms: Frame) -> str:
    """Fewest and most rooms of a row's numbers."""
    counts = sorted({int(n) for n in rooms.dropna()})
    return "-".join(str(n) for n in dict.fromkeys((*counts[:1], *counts[-1:])))


def _difference(cell: Any) -> str:  # noqa: ANN401
    """The difference of a line of `Filled.numbers`."""
    return difference_text(cell.metric, cell.difference, cell.difference_low, cell.difference_high)


def difference_text(metric: str, mean: float, low: float, high: float) -> str:
    """A difference and its interval in the unit of the column; `-` where there is none."""
    middle, *ends = (shown(metric, value, sign=True) for value in (mean, low, high))
    return middle if middle == "-" else f"{middle} [{', '.join(ends)}]"


def gain_text(metric: str, values: Mapping[int, float], reference: Mapping[int, float]) -> str:
    """The first less the second, in the rooms that both have; `-` where there are none."""
    gain = paired_rooms(values, reference)
    return "-" if gain is None else difference_text(metric, gain.mean, gain.low, gain.high)


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
    from pandas import concat

    lines = concat([_lines(filled, seeds) for filled in tables])
    chances = lines[["p", "p_holm"]].map("{:.4g}".format, na_action="ignore")
    write_csv(lines.assign(unit=lines.metric.map(_unit), **chances), FIELDS, path)


def _lines(filled: Filled, seeds: Mapping[str, str]) -> Frame:
    """The numbers of a table with what names them."""
    rows = filled.table.rows
    about = {
        "row": [row.label for row in rows],
        "quoted": ["yes" if row.source is None else "" for row in rows],
        "command": [command_of(r.source, seeds[r.source.rooms]) if r.source else "" for r in rows],
    }
    named = {
        name: filled.numbers.place.map(dict(enumerate(words))) for name, words in about.items()
    }
    return filled.numbers.assign(table=filled.table.title, **named)


def _unit(metric: str) -> str:
    column = COLUMNS[metric]
    return "rad" if column.unit == "°" else "m" if column.factor in (100, 1000) else ""


# Small line plots as SVG files, a panel beside the other.


SIZE = (4.2, 3.1)  # [inch] of a panel
ACROSS = 3  # panels in a row
LOOK: Any = {
    "svg.hashsalt": "mover",
    "svg.fonttype": "none",
    "font.size": 9,
}  # the same bytes each time


@dataclass(frozen=True)
class Line:
    """A curve with intervals."""

    label: str
    points: tuple[tuple[float, float], ...]
    """(x, y), x ascending."""
    spans: tuple[tuple[float, float], ...] = ()
    """Lowest and highest y at each point; empty: not drawn."""


@dataclass(frozen=True)
class Panel:
    """A plot."""

    title: str
    x: str
    y: str
    lines: tuple[Line, ...]


def draw_panels(panels: Sequence[Panel]) -> str:
    """All panels in one SVG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    drawn = [panel for panel in panels if any(line.points for line in panel.lines)]
    columns = max(1, min(ACROSS, len(drawn)))
    rows = max(1, math.ceil(len(drawn) / columns))
    text = io.StringIO()
    with rc_context(LOOK):
        figure = Figure((SIZE[0] * columns, SIZE[1] * rows), layout="constrained")
        for place, panel in enumerate(drawn, 1):
            _draw(panel, figure.add_subplot(rows, columns, place))
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _draw(panel: Panel, axes: Any) -> None:  # noqa: ANN401
    for index, line in enumerate(panel.lines):
        if line.points:
            x, y = zip(*line.points, strict=True)
            ends = [(m - low, high - m) for m, (low, high) in zip(y, line.spans, strict=False)]
            axes.errorbar(
                x, y, list(zip(*ends, strict=True)) or None, label=line.label, marker="o",
                markersize=4, color=css(PALETTE[index % len(PALETTE)]),
            )  # fmt: skip
    axes.set_title(panel.title, loc="left", fontweight="bold")
    axes.set_xlabel(panel.x)
    axes.set_ylabel(panel.y)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
