"""`check` before a run; `evaluate`, `export`, `render` and `view` after it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover.app.pictures.config import STILL, RenderConfig, check_ending
from mover.core.settings import int_in
from mover.io.formats import chosen, names


@dataclass(frozen=True)
class CheckArgs:
    """Validate a capture, list the evidence of each object, draw the initial overlay."""

    source: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """The capture folder (or whatever --format reads)."""
    out: Path = Path("check.png")
    """The picture of the initial scene and some bodies over the reference image, with the boxes
    and masks that were given."""
    mend: Path | None = None
    """A new folder for the capture without the faults that are named."""
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
    """Simulate both scenes in MuJoCo (the extra physics) for the share of objects that stay."""


def check(arguments: Sequence[str]) -> None:
    """`mover check`."""
    args = parsed(CheckArgs, "mover check", arguments)
    check_ending("--out", args.out, STILL)
    read = chosen("--format", args.format, "capture")
    from mover.app.pictures.overlay import save_overlay
    from mover.io.capture.evidence import evidence_table, gather_evidence
    from mover.io.capture.faults import check_against_picture, write_mended
    from mover.pipeline.result import warnings_of

    capture = read(args.source)
    warnings, estimates = warnings_of(capture)
    say(evidence_table(capture, gather_evidence(capture)))
    save_overlay(capture, args.out)
    findings = check_against_picture(capture)
    for warning in dict.fromkeys((*findings.warnings, *warnings)):
        say(f"warning: {warning}")
    if findings.faults and args.mend is None:
        say(f"a capture without that: mover check {args.source} --mend NEW")
    say("\n".join((*findings.summary, *estimates)))
    if args.mend is not None:
        write_mended(capture, findings, args.source, args.mend)
        say(f"{args.mend}: wrote the capture without {len(findings.faults)} faults")
    say(f"{args.source} is a valid capture; its initial scene is drawn in {args.out}")


def evaluate(arguments: Sequence[str]) -> None:
    """`mover evaluate`."""
    args = parsed(EvaluateArgs, "mover evaluate", arguments)
    from mover.evaluate.evaluation import evaluate_folder, table

    say(table(evaluate_folder(args.out, args.truth, physics=args.stable)))


if TYPE_CHECKING:
    Target = str
else:
    Target = Literal[tuple(names("export"))]  # the table's names are refused or shown by the parser


@dataclass(frozen=True)
class ExportArgs:
    """Write a result for other programs, into OUT/export."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    to: tuple[Target, ...] = ("glb",)
    """What to write; several with spaces between them."""
    capture: Path | None = None
    """Folder of the capture: its bodies.npz has the parameters of the bodies."""
    body: Literal["auto", "skin", "morph", "none"] = "auto"
    """glb: how people move: on bones, by exact shapes of some frames, or not at all (also usd)."""
    up: Literal["y", "z"] = "y"
    """amass, usd, contacts: y is the world of scene.json, z that of AMASS and of simulators."""


def export(arguments: Sequence[str]) -> None:
    """`mover export`."""
    args = parsed(ExportArgs, "mover export", arguments)
    from mover.io.export.finished import Exported, read_finished

    writers = {target: chosen("--to", target, "export") for target in args.to}
    finished, folder = read_finished(args.out, args.capture), args.out / "export"
    options = {"glb": {"body": args.body}, "amass": {"up": args.up}, "contacts": {"up": args.up}}
    options |= {"usd": {"body": args.body, "up": args.up}}
    for target, write in writers.items():
        found: Exported = write(finished, folder, **options.get(target, {}))
        shown = found.files if len(found.files) <= 3 else found.files[:1]
        more = f" and {len(found.files) - 1} more" if len(found.files) > 3 else ""
        say(f"{target}: {', '.join(str(file) for file in shown)}{more}")
        for note in found.notes:
            say(f"  {note}")


@dataclass(frozen=True)
class RenderArgs:
    """Draw a result without a screen, as a picture or a film."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    to: Path = Path("room.png")
    """The file: .png or .jpg for one picture, .mp4 for a film."""
    capture: Path | None = None
    """Folder of the capture: its video, or else its reference image, is behind the furniture."""
    config: Annotated[RenderConfig, arg(name="")] = field(default_factory=RenderConfig)


def render(arguments: Sequence[str]) -> None:
    """`mover render`."""
    args = parsed(RenderArgs, "mover render", arguments)
    from mover.app.pictures.render import render_result

    count = render_result(args.out, args.to, args.config, args.capture)
    what = "one picture" if count == 1 else f"{count} pictures"
    say(f"{args.to}: {what}")


@dataclass(frozen=True)
class ViewArgs:
    """Look at a result in the browser, and correct it: `mover run --edits` solves it again."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of the result."""
    edits: Path | None = None
    """The list of edits; by default OUT/edits.json."""
    port: Annotated[int, int_in(1, 65535)] = 8080
    """The next free one is taken where it is in use."""


def view(arguments: Sequence[str]) -> None:
    """`mover view`."""
    args = parsed(ViewArgs, "mover view", arguments)
    from mover.app.viewer.show import view_result

    view_result(args.out, args.edits, args.port)
