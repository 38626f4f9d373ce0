"""What `run` does, the main job; `batch`, which runs it on thousands of captures; and `demo`."""

import json
import os
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.batch import CONFIG, PRODUCTS, SUMMARY, BatchJob, RayOptions
from mover.app.cli import config as flags
from mover.app.cli import say
from mover.core.errors import InputError
from mover.core.files import fingerprint_of_files, replacing, sources
from mover.core.settings import Seconds, int_in
from mover.io.formats import chosen
from mover.pipeline.presets import PRESETS, Config

if TYPE_CHECKING:
    from mover.app.results import Origin
    from mover.core.run import Run
    from mover.core.types import Capture, Room

FINISHED = "finished"  # in OUT/stages: of what the whole result is
THREADS = 1  # of torch: its operations here are small, and threads that wait for others cost more


@dataclass(frozen=True)
class RunArgs:
    """Reconstruct a room from a capture folder."""

    source: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """The capture folder (or whatever --format reads)."""
    out: Path = Path("out")
    """Folder for the result; a run that was killed goes on there."""
    format: str = "folder"
    """How the capture is written; see docs/data.md."""
    preset: str = "robust"
    """paper, printed or robust: the settings that the other flags change."""
    config_from: Annotated[Path | None, arg(name="config")] = None
    """A file of settings (a run.json) in place of a preset; it may set what has no flag, too."""
    edits: Path | None = None
    """A list of edits (edits.json of `mover view`) that is applied first."""
    device: flags.Device = "cpu"
    """Where the heavy stages compute: cpu, cuda (an NVIDIA GPU; see docs/engine.md) or auto."""
    refine: bool = False
    """At the end, refine the people with the room they helped to find: bodies.npz holds them."""


def parse_run(arguments: Sequence[str]) -> tuple[RunArgs, Config]:
    """What `mover run` is asked for, and the settings."""
    config = flags.chosen_config(arguments, PRESETS)
    return flags.parsed_with(RunArgs, config, flags.RUN_SETTINGS, "mover run", arguments)


def run(arguments: Sequence[str]) -> None:
    """`mover run`; nothing is read where the result of the same inputs is there already."""
    args, config = parse_run(arguments)
    said = config, args.source.resolve(), args.format, args.device, args.refine, sources()
    more = (args.edits, os.environ.get("MOVER_BODY_MODELS"))
    made = fingerprint_of_files(repr(said), args.source, *(Path(path) for path in more if path))
    mark = args.out / "stages" / FINISHED
    if mark.is_file():
        if mark.read_bytes() == (made + _products(args.out)).encode():
            log = json.loads((args.out / "run.json").read_text())
            for line in (*(f"warning: {text}" for text in log["warnings"]), *log["estimates"]):
                say(line)
            say(f"{args.out}: has the result of this capture and these settings already")
            return
        mark.unlink()
    read = chosen("--format", args.format, "capture")
    from mover.app.results import Origin
    from mover.core.devices import device_of
    from mover.io.capture.edits import read_edits
    from mover.io.files.fields import read_json

    device, capture = device_of(args.device), read(args.source)
    edits = () if args.edits is None else read_edits(args.edits)
    origin = Origin(str(args.source.resolve()), args.format, edits, args.refine, device)
    with suppress(InputError):  # of a log that is missing or damaged
        old = read_json(args.out / "run.json").get("source").value
        if old not in ("", origin.source):
            say(f"note: {args.out} has the result of {old}, which is replaced")
    reconstruct_into(args.out, capture, config, origin)
    with replacing(mark) as part:
        part.write_text(made + _products(args.out))
    say(f"report: {args.out / 'report.html'}")


def _products(out: Path) -> str:
    """What a finished result is."""
    names = (*PRODUCTS, "bodies.npz", "report.html")
    return fingerprint_of_files("", *(out / name for name in names))


def reconstruct_into(
    out: Path, capture: "Capture", config: Config, origin: "Origin", report: bool = True
) -> "tuple[Room, Run]":
    """Run the main job on the edited capture and write its result."""
    import torch

    from mover.app.cli import Bar
    from mover.app.results import write_results
    from mover.core.observe import Step
    from mover.core.run import Run
    from mover.extensions import reconstruct
    from mover.io.capture.edits import apply_edits

    torch.set_num_threads(THREADS)
    capture, pinned = apply_edits(capture, origin.edits)
    with Bar() as bar:
        run = Run(out, bar, device=origin.device)
        room = reconstruct(capture, config, run, pinned)
        if origin.refine:
            from mover.pipeline.refine import refined_room

            room = refined_room(room, capture, bar)
        bar(Step("writing the result", 0, 1))
        write_results(capture, room, config, run, origin, report=report)
    for warning in room.warnings:
        say(f"warning: {warning}")
    say("\n".join(room.estimates))
    return room, run


@dataclass(frozen=True)
class BatchArgs:
    """Run thousands of captures; what is finished is not run again."""

    source: Annotated[Positional[Path], arg(metavar="LIST")]
    """A text file with one capture a line, or a folder of captures."""
    out: Path = Path("batch")
    """Folder of all results and summary.csv, which has the reasons of failures."""
    engine: Literal["local", "ray"] = "local"
    """Where captures run: on this machine, or on a Ray cluster."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """Captures at a time on this machine; 0: as many as it has cores."""
    limit: Seconds = 0.0
    """Most seconds for one capture; 0: no limit."""
    threads: Annotated[int, int_in(1, 1024)] = 1
    """Threads of each capture."""
    retry: bool = False
    """Run those again that failed before."""
    format: str = "folder"
    """How the captures are written; see docs/data.md."""
    preset: str = "robust"
    """paper, printed or robust: the settings that the other flags change."""
    config_from: Annotated[Path | None, arg(name="config")] = None
    """A file of settings (a run.json) in place of a preset; it may set what has no flag, too."""
    refine: bool = False
    """At the end of each run, refine the people with the room they helped to find."""
    ray: RayOptions = field(default_factory=RayOptions)


def batch(arguments: Sequence[str]) -> None:
    """`mover batch`; the exit code is 1 if a capture failed."""
    config = flags.chosen_config(arguments, PRESETS)
    args, config = flags.parsed_with(
        BatchArgs, config, flags.RUN_SETTINGS, "mover batch", arguments
    )
    from mover.app.batch import captures_in, run_batch

    jobs = _jobs(args, config, captures_in(args.source, args.out))
    ray = args.ray if args.engine == "ray" else None
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    outcomes = run_batch(jobs, args.out, args.workers or own or 1, ray, args.retry)
    states = Counter(outcome.state for outcome in outcomes)
    before = f" ({states['kept']} of them before)" if states["kept"] else ""
    done = states["done"] + states["kept"]
    say(f"{done} done{before}, {states['failed']} failed: {args.out / SUMMARY}")
    if states["failed"]:
        say("the summary has the reasons; --retry runs those again that failed")
        raise SystemExit(1)


def _jobs(args: BatchArgs, config: Config, captures: Sequence[Path]) -> list[BatchJob]:
    """A job for each capture; the settings are handed over in one file for all."""
    from mover import __version__
    from mover.app.batch import names_of
    from mover.core import records
    from mover.io.files.fields import write_json

    out = args.out.resolve()
    tree = {"format": "mover-config", "config": records.plain(config)}
    write_json(tree, out / CONFIG)
    settings = records.fingerprint(config, args.format, __version__, args.refine)
    more = ["--format", args.format, "--config", str(out / CONFIG)]
    more += ["--refine"] if args.refine else []
    jobs: list[BatchJob] = []
    for name, capture in zip(names_of(captures), captures, strict=True):
        words = (sys.executable, "-m", "mover", "run", str(capture), "--out", str(out / name))
        mark = fingerprint_of_files(settings, capture)
        paths = (str(capture), str(out / name))
        jobs.append(BatchJob(name, *paths, (*words, *more), mark, args.limit, args.threads))
    return jobs


@dataclass(frozen=True)
class DemoArgs:
    """Reconstruct a known room from a capture with realistic noise, and compare with the truth."""

    out: Path = Path("demo")
    """Folder for the capture and the result."""
    preset: str = "robust"
    """paper, printed or robust."""
    device: flags.Device = "cpu"
    """cpu, cuda or auto."""


def demo(arguments: Sequence[str]) -> None:
    """`mover demo`."""
    args = flags.parsed(DemoArgs, "mover demo", arguments)
    config = flags.preset_named(args.preset, PRESETS)
    from mover.app.demo import write_demo
    from mover.app.report.page import write_report
    from mover.app.results import Origin, report_of
    from mover.core.devices import device_of
    from mover.evaluate.evaluation import FIRST, evaluate_folder, table
    from mover.io.capture.scene_file import read_scene
    from mover.io.formats import read

    device, folder = device_of(args.device), args.out / "capture"
    if not folder.exists():
        say("writing the capture of a known room: furniture, a person, masks ...")
        write_demo(folder)
    capture = read("folder", folder)
    origin = Origin(str(folder.resolve()), device=device)
    found, run = reconstruct_into(args.out / "room", capture, config, origin, report=False)
    metrics = evaluate_folder(args.out / "room", folder / "truth", physics=False)
    truth = read_scene(folder / "truth" / "scene.json", None)
    content = report_of(capture, found, config, run, truth=truth, metrics=metrics)
    report = write_report(args.out / "room", content)
    say(f"\n{table(metrics, FIRST)}\n\nreport: {report}")
