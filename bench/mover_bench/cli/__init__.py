"""What `demo`, `rooms`, `experiment` and `paper-table` do: known rooms, the paper's tables."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import Device, parsed, preset_named
from mover.app.cli.run import reconstruct_into
from mover.core.settings import Seconds, Seed, float_in, int_in
from mover_bench.studies.args import ExperimentArgs, MakeArgs, StudyArgs


@dataclass(frozen=True)
class DemoArgs:
    """Make a known room with realistic noise, reconstruct it, and compare with the truth."""

    out: Path = Path("demo")
    """Folder for the capture and the result."""
    seed: Seed = 0
    """Seed of the noise."""
    preset: str = "robust"
    """paper or robust."""
    device: Device = "cpu"
    """cpu, cuda or auto."""


def demo(arguments: Sequence[str]) -> None:
    """`mover demo`."""
    args = parsed(DemoArgs, "mover demo", arguments)
    config = preset_named(args.preset)
    from mover.app.report.page import write_report
    from mover.app.results import Origin, report_of, write_truth
    from mover.core.devices import device_of
    from mover.evaluate.evaluation import evaluate_folder, table
    from mover.io.capture.folder import write_capture
    from mover.io.capture.scene_file import read_scene
    from mover.io.formats import read
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise
    from mover_bench.rooms.room import demo_room

    device, folder = device_of(args.device), args.out / "capture"
    if not (folder / "truth" / "scene.json").exists():
        say("making a known room: furniture, a person, masks ...")
        room = demo_room()
        write_capture(add_noise(room, NoiseConfig(), args.seed), folder)
        write_truth(room.truth, room.bodies, folder / "truth")
    capture = read("folder", folder)
    origin = Origin(str(folder.resolve()), device=device)
    found, run = reconstruct_into(args.out / "room", capture, config, origin, report=False)
    metrics = evaluate_folder(args.out / "room", folder / "truth", physics=False)
    truth = read_scene(folder / "truth" / "scene.json", None)
    content = report_of(capture, found, config, run, truth=truth, metrics=metrics)
    report = write_report(args.out / "room", content)
    say(f"\n{table(metrics)}\n\nreport: {report}")


@dataclass(frozen=True)
class RoomsArgs:
    """Make a known room in which somebody moves as in a clip of motion capture, with its truth."""

    asf: Annotated[Positional[Path], arg(metavar="ASF")]
    """The actor's skeleton, as the library of Carnegie Mellon University has it."""
    amc: Annotated[Positional[Path], arg(metavar="AMC")]
    """The clip of that actor."""
    out: Path = Path("rooms")
    """Folder for the capture; its `truth` holds the truth."""
    seed: Seed = 0
    """Of the room and of the noise."""
    fps: Annotated[float, float_in(1e-3, 120)] = 5.0
    """Frames a second, at most 120."""
    seconds: Seconds = 0.0
    """Length of the part that is shown, from the beginning [s]; 0: the whole clip."""


def clip_rooms(arguments: Sequence[str]) -> None:
    """`mover rooms`."""
    args = parsed(RoomsArgs, "mover rooms", arguments)
    from mover.app.results import write_truth
    from mover.io.capture.folder import write_capture
    from mover_bench.rooms.clip import clip_room
    from mover_bench.rooms.config import NoiseConfig, RoomConfig
    from mover_bench.rooms.noise import add_noise

    config = RoomConfig(fps=args.fps, least_frames=1, least_touches=0)
    room = clip_room((args.asf, args.amc), args.seed, config, args.seconds)
    write_capture(add_noise(room, NoiseConfig(), args.seed), args.out)
    write_truth(room.truth, room.bodies, args.out / "truth")
    say(f"{len(room.truth.objects)} pieces, {len(room.bodies.frame)} frames: {args.out}")


def run_presets(arguments: Sequence[str]) -> None:
    """`mover experiment`, and by its first word `study` or `make`."""
    if arguments and arguments[0] in MORE:
        MORE[arguments[0]](arguments[1:])
        return
    args = parsed(ExperimentArgs, "mover experiment", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.studies.run import run_experiment

    with Bar() as bar:
        summary = run_experiment(args, bar)
    say(f"{summary.read_text()}\nsummary: {summary}")


def run_studies(arguments: Sequence[str]) -> None:
    """`mover experiment study`."""
    args = parsed(StudyArgs, "mover experiment study", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.studies.study import run_study

    with Bar() as bar:
        pages = run_study(args, bar)
    for page in pages:
        say(f"{page.read_text()}\nsummary: {page}")


def make_rooms(arguments: Sequence[str]) -> None:
    """`mover experiment make`."""
    args = parsed(MakeArgs, "mover experiment make", arguments)
    from mover.app.cli.progress import Bar
    from mover_bench.studies.make import make_set, told

    with Bar() as bar:
        made = make_set(args, bar)
    say(told(made, args.check))
    if made.failed or made.changed:
        raise SystemExit(1)


MORE: dict[str, Callable[[Sequence[str]], None]] = {"study": run_studies, "make": make_rooms}
"""What the first word of the command may ask for instead."""


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
