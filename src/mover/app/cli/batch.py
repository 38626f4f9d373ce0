"""What `batch` does."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import AvoidSubcommands, Positional, Suppress, arg

from mover.app.batch import CAPTURE, OUT, BatchPlan, captures_in, cores, counted, run_batch
from mover.app.batch.engines import ARRAY, EngineOptions, RayOptions, SlurmOptions
from mover.app.cli.config import chosen_config, parsed
from mover.app.cli.console import say
from mover.core.settings import Seconds, int_in
from mover.pipeline.presets import Config


@dataclass(frozen=True)
class BatchArgs:
    """Run thousands of captures; what is finished is not run again."""

    source: Annotated[Positional[Path], arg(metavar="LIST")]
    """A text file with one capture a line, or a folder of captures."""
    out: Path = Path("batch")
    """Folder of all results, the failures and summary.csv."""
    engine: Literal["local", "ray", "slurm"] = "local"
    """Where captures run: on this machine, on a Ray cluster, or under SLURM."""
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """Captures at a time; 0: as many as this machine has cores, on a cluster as it has room for."""
    limit: Seconds = 0.0
    """Most seconds for one capture; 0: no limit."""
    threads: Annotated[int, int_in(1, 1024)] = 1
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
    config: Annotated[Suppress[Config], arg(name="")] = field(default_factory=Config)


def batch(arguments: Sequence[str]) -> None:
    """`mover batch`; the exit code is 1 if a capture failed."""
    args = _parse_batch(arguments)
    from mover.core import records

    captures = captures_in(args.source, args.out)
    plan = BatchPlan(
        captures=captures,
        out=args.out,
        command=_command(args),
        fingerprint=records.fingerprint(args.config, args.format, _version(), args.refine),
        limit=args.limit,
        threads=args.threads,
    )
    alone = args.engine == "local" or (args.engine == "ray" and args.ray.address == "local")
    workers = args.workers or (cores() if alone else ARRAY)  # a cluster itself keeps them waiting
    options = EngineOptions(args.engine, workers, args.ray, args.slurm)
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

    def both(
        args: Annotated[BatchArgs, arg(name="")], config: Annotated[Config, arg(name="")] = config
    ) -> BatchArgs:
        """Run thousands of captures; what is finished is not run again."""
        return replace(args, config=config)

    return parsed(both, "mover batch", rest, AvoidSubcommands)


def _command(args: BatchArgs) -> tuple[str, ...]:
    """The command of one capture; the settings are handed over in one file for all."""
    file = args.out.resolve() / "config.json"
    from mover.core import records
    from mover.io.files.fields import write_json

    tree = {"format": "mover-config", "config": records.plain(args.config)}
    write_json(tree, file)
    start = (sys.executable, "-m", "mover", "run", CAPTURE, "--out", OUT)
    refine = ("--refine",) if args.refine else ()
    return (*start, "--format", args.format, "--config", str(file), *refine)


def _version() -> str:
    from mover import __version__

    return __version__
