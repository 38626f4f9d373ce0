"""What `experiment` and `paper-table` do: known rooms, the paper's tables."""

from collections.abc import Sequence

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover_bench.experiment.args import ExperimentArgs, TableArgs


def experiment(arguments: Sequence[str]) -> None:
    """`mover experiment`."""
    args = parsed(ExperimentArgs, "mover experiment", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.experiment.run import run_experiment
    from mover_bench.real.clips import judge_clips
    from mover_bench.real.judge import judge_i3db

    real = {"i3db": judge_i3db, "clips": judge_clips}  # all other sets are known rooms
    with Bar() as bar:
        summary = real.get(args.set, run_experiment)(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


def show_paper_table(arguments: Sequence[str]) -> None:
    """`mover paper-table`."""
    args = parsed(TableArgs, "mover paper-table", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.tables.paper_table import paper_table, planned

    if not args.look:
        say(planned(args))
    with Bar() as bar:
        page = paper_table(args, bar)
    say(f"{page.read_text()}\ntable: {page}")
