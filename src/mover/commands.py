"""What each command does."""

import importlib
import logging
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import AvoidSubcommands, Positional, arg

from . import records
from .commands_config import chosen_config, preset_named
from .devices import Choice, device_of
from .presets import Config
from .progress import Bar, both

log = logging.getLogger(__name__)
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
    """paper, release or robust: the settings that the other flags change."""
    config_from: Annotated[Path | None, arg(name="config")] = None
    """A run.json whose settings are used instead of a preset's."""
    edits: Path | None = None
    """A list of edits (edits.json of `mover view`) that is applied first."""
    view: bool = False
    """Watch the furniture move in the browser (extra `viewer`)."""
    device: Choice = "cpu"
    """Where the heavy stages compute: cpu, cuda (an NVIDIA GPU; see docs/engine.md) or auto."""
    refine: bool = False
    """At the end, refine the people with the room they helped to find: bodies.npz holds them."""


@dataclass(frozen=True)
class CheckArgs:
    """Validate a capture, list the evidence of each object, draw the initial overlay."""

    source: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """The capture folder (or whatever --format reads)."""
    out: Path = Path("check.png")
    """The picture of the initial scene over the reference image."""
    format: str = "folder"
    """How the capture is written."""


@dataclass(frozen=True)
class EvaluateArgs:
    """Compare a result with the truth; writes OUT/metrics.json."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    truth: Path
    """Folder with the true scene.json, meshes, and bodies.npz if there are any."""


@dataclass(frozen=True)
class DemoArgs:
    """Make a known room with realistic noise, reconstruct it, and compare with the truth."""

    out: Path = Path("demo")
    """Folder for the capture and the result."""
    seed: int = 0
    """Seed of the noise."""
    preset: str = "robust"
    """paper, release or robust."""
    device: Choice = "cpu"
    """cpu, cuda or auto."""


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of a command and run it; the exit code."""
    try:
        _COMMANDS[name](arguments)
    except records.InputError as error:
        _say(f"mover {name}: {error}", sys.stderr)
        return 2
    except KeyboardInterrupt:
        _say(f"\nmover {name}: stopped; the same command goes on from here", sys.stderr)
        return 130
    return 0


def parse_run(arguments: Sequence[str]) -> tuple[RunArgs, Config]:
    """What `mover run` is asked for, and the settings."""
    config, rest = chosen_config(arguments)

    def both(
        args: Annotated[RunArgs, arg(name="")], config: Annotated[Config, arg(name="")] = config
    ) -> tuple[RunArgs, Config]:
        """Reconstruct a room from a capture folder."""
        return args, config

    return tyro.cli(both, prog="mover run", args=rest, config=(AvoidSubcommands,))


def _run(arguments: Sequence[str]) -> None:
    args, config = parse_run(arguments)
    from .readers import read
    from .readers.edits_file import read_edits
    from .results import Origin

    device = device_of(args.device)
    capture = read(args.format, args.source)
    edits = () if args.edits is None else read_edits(args.edits)
    origin = Origin(str(args.source.resolve()), args.format, edits, args.refine, device)
    if args.view:
        view = importlib.import_module(".commands_view", __package__)
        view.run_in_view(capture, config, args.out, origin)
        return
    reconstruct_into(args.out, capture, config, origin)
    _say(f"report: {args.out / 'report.html'}")


def reconstruct_into(
    out: Path,
    capture: Any,  # noqa: ANN401
    config: Config,
    origin: Any,  # noqa: ANN401
    watch: Any = None,  # noqa: ANN401
) -> Any:  # noqa: ANN401
    """Run the main job on the edited capture and write its result; `watch` sees every step."""
    import torch

    from .edits import apply_edits
    from .pipeline import reconstruct
    from .results import write_results
    from .run import Run

    torch.set_num_threads(THREADS)
    capture, pinned = apply_edits(capture, origin.edits)
    with Bar() as bar:
        observe = bar if watch is None else both(bar, watch)
        run = Run(out, observe, device=origin.device)
        room = reconstruct(capture, config, run, pinned)
        if origin.refine:
            from .refinement import refined_room

            room = refined_room(room, capture, bar)
    write_results(capture, room, config, run, origin)
    for warning in room.warnings:
        _say(f"warning: {warning}")
    return room, run


def _check(arguments: Sequence[str]) -> None:
    args = tyro.cli(CheckArgs, prog="mover check", args=list(arguments))
    from .readers import read
    from .readers.evidence import evidence_table, gather_evidence
    from .report import save_overlay

    capture = read(args.format, args.source)
    _say(evidence_table(capture, gather_evidence(capture)))
    save_overlay(capture, args.out)
    _say(f"{args.source} is a valid capture; its initial scene is drawn in {args.out}")


def _evaluate(arguments: Sequence[str]) -> None:
    args = tyro.cli(EvaluateArgs, prog="mover evaluate", args=list(arguments))
    from .evaluate import evaluate_folder, table

    _say(table(evaluate_folder(args.out, args.truth)))


def _demo(arguments: Sequence[str]) -> None:
    args = tyro.cli(DemoArgs, prog="mover demo", args=list(arguments))
    config, device = preset_named(args.preset), device_of(args.device)
    from .evaluate import evaluate_folder, table
    from .readers import read
    from .readers.folder import write_capture
    from .readers.scene_file import read_scene
    from .report import write_report
    from .results import Origin, report_of, write_truth
    from .rooms.noise import NoiseConfig, add_noise
    from .rooms.room import demo_room

    folder = args.out / "capture"
    if not (folder / "truth" / "scene.json").exists():
        _say("making a known room: furniture, a person, masks ...")
        room = demo_room()
        write_capture(add_noise(room, NoiseConfig(), args.seed), folder)
        write_truth(room.truth, room.bodies, folder / "truth")
    capture = read("folder", folder)
    origin = Origin(str(folder.resolve()), device=device)
    found, run = reconstruct_into(args.out / "room", capture, config, origin)
    metrics = evaluate_folder(args.out / "room", folder / "truth")
    truth = read_scene(folder / "truth" / "scene.json", None)
    content = report_of(capture, found, config, run, truth=truth, metrics=metrics)
    report = write_report(args.out / "room", content)
    _say(f"\n{table(metrics)}\n\nreport: {report}")


def _lazily(module: str, name: str) -> Callable[[Sequence[str]], None]:
    """A command of another module, which is imported when the command runs."""

    def run(arguments: Sequence[str]) -> None:
        importlib.import_module(f".{module}", __package__).COMMANDS[name](arguments)

    return run


def _say(text: str, stream: Any = None) -> None:  # noqa: ANN401
    (stream or sys.stdout).write(text + "\n")


_COMMANDS = {
    "demo": _demo,
    "check": _check,
    "run": _run,
    "evaluate": _evaluate,
    "experiment": _lazily("commands_experiment", "experiment"),
    "import": _lazily("commands_import", "import"),
    "paper-table": _lazily("commands_table", "paper-table"),
    **{name: _lazily("commands_perceive", name) for name in ("perceive", "layout")},
    "bodies": _lazily("commands_people", "bodies"),
    "fit": _lazily("commands_fit", "fit"),
    **{name: _lazily("commands_refine", name) for name in ("refine", "contacts")},
    **{name: _lazily("commands_share", name) for name in ("export", "settle", "batch")},
    "render": _lazily("commands_render", "render"),
    "view": _lazily("commands_view", "view"),
}
