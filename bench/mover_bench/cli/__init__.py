"""What `experiment` and `paper-table` do: known rooms, the paper's tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover.core.settings import int_in
from mover_bench.experiment.args import ExperimentArgs


def experiment(arguments: Sequence[str]) -> None:
    """`mover experiment`."""
    args = parsed(ExperimentArgs, "mover experiment", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.experiment.run import run_experiment
    from mover_bench.real.judge import judge_i3db

    with Bar() as bar:
        summary = (judge_i3db if args.set == REAL else run_experiment)(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


REAL = "i3db"
"""The set of real recordings; all others are known rooms."""
Table = Literal["prox", "prox-quantitative", "pigraphs"]


@dataclass(frozen=True)
class PaperTableArgs:
    """Make all rows of the paper's table for your copy of a data set, beside the published ones.

    Rows run beside each other and go on where they stopped; the page is RESULTS/TABLE-PRESET.md,
    its numbers are the .csv beside it.
    """

    table: Annotated[Positional[Table], arg(metavar="TABLE")]
    """prox, prox-quantitative or pigraphs."""
    captures: Annotated[Positional[Path], arg(metavar="CAPTURES")]
    """Folder of captures made by `mover import`, one for each recording, under its name."""
    results: Annotated[Positional[Path], arg(metavar="RESULTS")]
    """Folder for the rows' results and the page."""
    preset: str = "robust"
    """paper or robust."""
    detected: Path | None = None
    """The same captures with boxes and masks of a detector (PointRend), for rows of their own."""
    only: tuple[str, ...] = ()
    """Rows whose names begin so, as initial full; empty: all."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """How many jobs run at once; 0: as many as there are cores."""
    look: bool = False
    """Run nothing: write the page from the jobs that are finished."""


def show_paper_table(arguments: Sequence[str]) -> None:
    """`mover paper-table`."""
    args = parsed(PaperTableArgs, "mover paper-table", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.tables.paper_table import TableArgs, paper_table

    asked = TableArgs(
        args.table, args.captures, args.results, args.detected, args.preset, args.workers,
        args.look, args.only,
    )  # fmt: skip
    with Bar() as bar:
        page = paper_table(asked, bar)
    say(f"{page.read_text()}\ntable: {page}")
