"""The bench's commands, `experiment` and `paper-table`. Imports no torch: `--help` is quick."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover.core.settings import int_in

Workers = Annotated[int, int_in(0, 10_000)]


@dataclass(frozen=True)
class ExperimentArgs:
    """Reconstruct known rooms with each variant and compare with the truth; resumes."""

    seeds: str = "0-9"
    """Which rooms: 0-9, or 0,3,5-7."""
    variants: tuple[str, ...] = ("robust", "paper")
    """Presets, other variants, or lists of them: ablation, parts, terms, readings, length,
    sensitivity.
    The first one is what the others are compared with."""
    out: Path = Path("experiments")
    """Folder for the results."""
    workers: Workers = 0
    """How many rooms are processed at once; 0: as many as there are cores."""
    set: str = "rooms"
    """Set of rooms, see docs/rooms.md; or i3db or clips, with --source."""
    source: Path | None = None
    """For the set i3db: the folder i3DB of amonszpart/iMapper. Its scenes are reconstructed with
    the first variant, from library furniture and from the true shapes. For clips: folders with
    video.mp4 and furniture.json (outlines), of which `mover video` makes rooms."""
    steps: Annotated[int, int_in(0, 1_000_000)] = 0
    """At most so many steps of each descent; 0: as many as the preset has."""


Table = Literal["prox", "prox-quantitative", "pigraphs"]


@dataclass(frozen=True)
class TableArgs:
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
    """paper, printed or robust."""
    detected: Path | None = None
    """The same captures with boxes and masks of a detector (PointRend), for rows of their own."""
    only: tuple[str, ...] = ()
    """Rows whose names begin so, as initial full; empty: all."""
    steps: Annotated[int, int_in(0, 1_000_000)] = 0
    """At most so many steps of each descent; 0: as many as the preset has."""
    device: Literal["auto", "cpu", "cuda"] = "cpu"
    """Where the heavy stages compute: a GPU shortens the steps of `paper` and `printed`."""
    vposer: Path | None = None
    """VPoser's weights: the table fits the baseline of the people itself, to the keypoints."""
    workers: Workers = 0
    """How many jobs run at once; 0: as many as there are cores."""
    look: bool = False
    """Run nothing: write the page from the jobs that are finished."""


def experiment(arguments: Sequence[str]) -> None:
    """`mover experiment`."""
    args = parsed(ExperimentArgs, "mover experiment", arguments)
    from mover.app.cli import Bar
    from mover_bench.experiment.job import run_experiment
    from mover_bench.experiment.real import judge_clips, judge_i3db

    real = {"i3db": judge_i3db, "clips": judge_clips}  # all other sets are known rooms
    with Bar() as bar:
        summary = real.get(args.set, run_experiment)(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


def show_paper_table(arguments: Sequence[str]) -> None:
    """`mover paper-table`."""
    args = parsed(TableArgs, "mover paper-table", arguments)
    from mover.app.cli import Bar
    from mover_bench.experiment.paper_table import paper_table, planned

    if not args.look:
        say(planned(args))
    with Bar() as bar:
        page = paper_table(args, bar)
    say(f"{page.read_text()}\ntable: {page}")
