"""What `check` and `evaluate` do."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed
from mover.app.cli.console import say
from mover.io.formats import chosen


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
    stable: bool = True
    """Simulate both scenes in MuJoCo (the extra physics) for the share of pieces that stay."""


def check(arguments: Sequence[str]) -> None:
    """`mover check`."""
    args = parsed(CheckArgs, "mover check", arguments)
    read = chosen("--format", args.format, "capture")
    from mover.app.pictures.overlay import save_overlay
    from mover.io.capture.evidence import evidence_table, gather_evidence
    from mover.pipeline.believable import warnings_of

    capture = read(args.source)
    warnings = warnings_of(capture)
    say(evidence_table(capture, gather_evidence(capture)))
    save_overlay(capture, args.out)
    for warning in warnings:
        say(f"warning: {warning}")
    say(f"{args.source} is a valid capture; its initial scene is drawn in {args.out}")


def evaluate(arguments: Sequence[str]) -> None:
    """`mover evaluate`."""
    args = parsed(EvaluateArgs, "mover evaluate", arguments)
    from mover.evaluate.evaluation import evaluate_folder, table

    say(table(evaluate_folder(args.out, args.truth, physics=args.stable)))
