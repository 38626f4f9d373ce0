"""What `experiment` does: presets on known rooms, and the paper's experiments."""

from collections.abc import Callable, Sequence

import tyro

from .console import say
from .progress import Bar


def run_presets(arguments: Sequence[str]) -> None:
    """`mover experiment`, and by its first word `study` or `make`."""
    if arguments and arguments[0] in MORE:
        MORE[arguments[0]](arguments[1:])
        return
    from .experiments.run import ExperimentArgs, run_experiment

    args = tyro.cli(ExperimentArgs, prog="mover experiment", args=list(arguments))
    with Bar() as bar:
        summary = run_experiment(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


def run_studies(arguments: Sequence[str]) -> None:
    """`mover experiment study`."""
    from .experiments.study import StudyArgs, run_study

    args = tyro.cli(StudyArgs, prog="mover experiment study", args=list(arguments))
    with Bar() as bar:
        pages = run_study(args, bar)
    for page in pages:
        say(f"{page.read_text()}\nsummary: {page}")


def make_rooms(arguments: Sequence[str]) -> None:
    """`mover experiment make`."""
    from .experiments.make import MakeArgs, make_set, told

    args = tyro.cli(MakeArgs, prog="mover experiment make", args=list(arguments))
    with Bar() as bar:
        made = make_set(args, bar)
    say(told(made, args.check))
    if made.failed or made.changed:
        raise SystemExit(1)


MORE: dict[str, Callable[[Sequence[str]], None]] = {"study": run_studies, "make": make_rooms}
"""What the first word of the command may ask for instead."""
COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {"experiment": run_presets}
