"""What `experiment` and `paper-table` do: known rooms, the paper's tables."""

from collections.abc import Sequence

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover_bench.experiment.args import ExperimentArgs, TableArgs

REAL = "i3db"
"""The set of real recordings; all others are known rooms."""


def experiment(arguments: Sequence[str]) -> None:
    """`mover experiment`."""
    args = parsed(ExperimentArgs, "mover experiment", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.experiment.run import run_experiment
    from mover_bench.real.judge import judge_i3db

    with Bar() as bar:
        summary = (judge_i3db if args.set == REAL else run_experiment)(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


def show_paper_table(arguments: Sequence[str]) -> None:
    """`mover paper-table`."""
    args = parsed(TableArgs, "mover paper-table", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.tables.paper_table import paper_table

    with Bar() as bar:
        page = paper_table(args, bar)
    say(f"{page.read_text()}\ntable: {page}")
