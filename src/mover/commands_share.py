"""What `export`, `settle` and `batch` do."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from tyro.conf import AvoidSubcommands, Positional, arg

from . import records
from .batch import CAPTURE, OUT, BatchPlan, captures_in, cores, counted, run_batch
from .batch_engines import EngineOptions, RayOptions, SlurmOptions
from .commands_config import chosen_config
from .console import say
from .presets import Config

Target = Literal["glb", "usd", "mjcf", "urdf", "ply", "bodies"]


@dataclass(frozen=True)
class ExportArgs:
    """Write a result for other programs, into OUT/export."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    to: tuple[Target, ...] = ("glb",)
    """glb, usd, mjcf, urdf, ply or bodies; several with spaces between them."""
    capture: Path | None = None
    """Folder of the capture: its bodies.npz tells the parameters of the bodies."""
    body: Literal["auto", "skin", "morph", "none"] = "auto"
    """glb: how people move: on bones, by exact shapes of some frames, or not at all."""
    up: Literal["y", "z"] = "y"
    """bodies: y is the world of scene.json, z that of AMASS."""


@dataclass(frozen=True)
class SettleArgs:
    """Let gravity act on a result; writes OUT/settle.json."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    truth: Path | None = None
    """Folder with the true scene.json, to settle it as well."""
    seconds: float = 3.0
    """Time of the simulation [s]."""


@dataclass(frozen=True)
class BatchArgs:
    """Run thousands of captures; what is finished is not run again."""

    source: Annotated[Positional[Path], arg(metavar="LIST")]
    """A text file with one capture a line, or a folder of captures."""
    out: Path = Path("batch")
    """Folder of all results, the failures and summary.csv."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where captures run: on this machine, on a Ray cluster, or under SLURM."""
    workers: int = 0
    """Captures at a time; 0: as many as this machine has cores."""
    limit: float = 0.0
    """Most seconds for one capture; 0: no limit."""
    threads: int = 1
    """Threads of each capture."""
    retry: bool = False
    """Run those again that failed before."""
    format: str = "folder"
    """How the captures are written; see docs/data.md."""
    preset: str = "robust"
    """paper, release or robust: the settings that the other flags change."""
    config_from: Annotated[Path | None, arg(name="config")] = None
    """A run.json whose settings are used instead of a preset's."""
    refine: bool = False
    """At the end of each run, refine the people with the room they helped to find."""
    ray: RayOptions = field(default_factory=RayOptions)
    slurm: SlurmOptions = field(default_factory=SlurmOptions)
    config: Annotated[Config, arg(name="")] = field(default_factory=Config)


def export(arguments: Sequence[str]) -> None:
    """`mover export`."""
    args = tyro.cli(ExportArgs, prog="mover export", args=list(arguments))
    from .exporters import EXPORTERS, Exported, export_bodies, export_glb, read_finished

    finished, folder = read_finished(args.out, args.capture), args.out / "export"
    for target in dict.fromkeys(args.to):
        found: Exported
        if target == "glb":
            found = export_glb(finished, folder, args.body)
        elif target == "bodies":
            found = export_bodies(finished, folder, args.up)
        else:
            found = EXPORTERS[target](finished, folder)
        shown = found.files if len(found.files) <= 3 else found.files[:1]
        more = f" and {len(found.files) - 1} more" if len(found.files) > 3 else ""
        say(f"{target}: {', '.join(str(file) for file in shown)}{more}")
        for note in found.notes:
            say(f"  {note}")


def settle(arguments: Sequence[str]) -> None:
    """`mover settle`."""
    args = tyro.cli(SettleArgs, prog="mover settle", args=list(arguments))
    from .settle import SettleConfig, settle_folder
    from .settle_table import settle_table

    if not 0 < args.seconds <= 60:
        raise records.InputError(f"--seconds: {args.seconds:g}, expected more than 0, at most 60")
    say(settle_table(settle_folder(args.out, args.truth, SettleConfig(args.seconds))))


def batch(arguments: Sequence[str]) -> None:
    """`mover batch`; the exit code is 1 if a capture failed."""
    args = _parse_batch(arguments)
    captures = captures_in(args.source, args.out)
    plan = BatchPlan(
        captures=captures,
        out=args.out,
        command=_command(args),
        fingerprint=records.fingerprint(args.config, args.format, _version(), args.refine),
        limit=args.limit,
        threads=args.threads,
    )
    options = EngineOptions(args.engine, args.workers or cores(), args.ray, args.slurm)
    outcomes = run_batch(plan, options, retry=args.retry)
    say(f"{counted(outcomes)}: {args.out / 'summary.csv'}")
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    for outcome in failed[:20]:
        say(f"  {outcome.name}: {outcome.reason}")
    if failed:
        say(f"records of what failed: {args.out / 'failures'}; --retry runs them again")
        raise SystemExit(1)


def _parse_batch(arguments: Sequence[str]) -> BatchArgs:
    config, rest = chosen_config(arguments)
    missing: Any = tyro.MISSING
    default = BatchArgs(missing, config=config)
    args = tyro.cli(
        BatchArgs, prog="mover batch", args=rest, default=default, config=(AvoidSubcommands,)
    )
    if args.workers < 0 or args.limit < 0 or args.threads < 1:
        raise records.InputError("--workers, --limit and --threads: expected 0, 0 and 1 or more")
    return args


def _command(args: BatchArgs) -> tuple[str, ...]:
    """The command of one capture; the settings are handed over in one file for all."""
    file = args.out.resolve() / "config.json"
    tree = {"format": "mover-config", "config": records.plain(args.config)}
    from .readers.fields import write_json

    write_json(tree, file)
    start = (sys.executable, "-m", "mover", "run", CAPTURE, "--out", OUT)
    refine = ("--refine",) if args.refine else ()
    return (*start, "--format", args.format, "--config", str(file), *refine)


def _version() -> str:
    from . import __version__

    return __version__


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "export": export,
    "settle": settle,
    "batch": batch,
}
