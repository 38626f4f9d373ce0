"""`check` before a run; `evaluate`, `export`, `render`, `view`, `refine`, `contacts` after it."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import REFINE_SETTINGS, parsed, parsed_with
from mover.app.pictures import STILL, RenderConfig, check_ending
from mover.core.errors import InputError
from mover.core.settings import Index, int_in
from mover.io.formats import chosen, names
from mover.stages.config import RefineBodiesConfig


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


SAME = 0.999  # IoU3D of one scene and itself


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
    from mover.io.export.scene_glb import losses_of
    from mover.pipeline.result import warnings_of

    capture = read(args.source)
    warnings, estimates = warnings_of(capture)
    say(evidence_table(capture, gather_evidence(capture)))
    save_overlay(capture, args.out)
    findings = check_against_picture(capture)
    for warning in dict.fromkeys((*findings.warnings, *warnings, *losses_of(capture.scene))):
        say(f"warning: {warning}")
    if findings.faults and args.mend is None:
        say(f"a capture without that: mover check {args.source} --mend NEW")
    say("\n".join((*findings.summary, *estimates)))
    if args.mend is not None:
        write_mended(capture, findings, args.source, args.mend)
        known = len(findings.faults)
        say(
            f"{args.mend}: wrote the capture without {known} {'fault' if known == 1 else 'faults'}"
            if known
            else f"{args.mend}: wrote the capture as it is, nothing to mend was found"
        )
    say(f"{args.source} is a valid capture; its initial scene is drawn in {args.out}")


def _check_result(folder: Path) -> None:
    """Say that a capture is no result."""
    if (folder / "camera.json").is_file() and not (folder / "run.json").is_file():
        cure = f"expected a result: mover run {folder} --out OUT"
        raise InputError(f"{folder}: is a capture, {cure}")
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a result of mover run")


def evaluate(arguments: Sequence[str]) -> None:
    """`mover evaluate`."""
    args = parsed(EvaluateArgs, "mover evaluate", arguments)
    _check_result(args.out)
    from mover.evaluate.evaluation import evaluate_folder, table

    found = evaluate_folder(args.out, args.truth, physics=args.stable)
    say(table(found))
    if found["initial"].get("iou3d", 0) > SAME:
        say(f"warning: --truth: {args.truth} has the initial scene of this result, not another one")


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
    _check_result(args.out)
    from mover.io.export.finished import FPS, Exported, read_finished

    writers = {target: chosen("--to", target, "export") for target in args.to}
    finished, folder = read_finished(args.out, args.capture), args.out / "export"
    options = {"glb": {"body": args.body}, "amass": {"up": args.up}, "contacts": {"up": args.up}}
    options |= {"usd": {"body": args.body, "up": args.up}}
    failed: list[str] = []
    for target, write in writers.items():
        try:
            found: Exported = write(finished, folder, **options.get(target, {}))
        except InputError as error:  # such as a package that is missing: the others are written
            failed.append(str(error))
            continue
        shown = found.files if len(found.files) <= 3 else found.files[:1]
        more = f" and {len(found.files) - 1} more" if len(found.files) > 3 else ""
        say(f"{target}: {', '.join(str(file) for file in shown)}{more}")
        for note in found.notes:
            say(f"  {note}")
    if finished.bodies is not None and finished.bodies.fps is None:
        say(f"note: bodies.npz has no frame rate ('fps'): {FPS:g} frames a second are assumed")
    if failed:
        raise InputError("; ".join(failed))


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
    _check_result(args.out)
    from mover.app.cli import Bar
    from mover.app.pictures.overlay import render_result

    with Bar() as bar:
        count = render_result(args.out, args.to, args.config, args.capture, bar)
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
    _check_result(args.out)
    from mover.app.viewer.show import view_result

    view_result(args.out, args.edits, args.port)


@dataclass(frozen=True)
class RefineArgs:
    """Refine the people of a result with its room; writes OUT/refined: bodies.npz, metrics.json."""

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Folder of a finished `mover run`."""
    capture: Path | None = None
    """Folder of its capture, for masks and contacts; by default where run.json says."""
    truth: Path | None = None
    """Folder with the true people: their errors are measured as well."""
    without: tuple[Literal["camgp", "sdf", "contact", "order", "masks"], ...] = ()
    """Evidence to leave out. camgp: no person under the floor, soles at rest on it; sdf: no person
    inside furniture; contact: seats, backs and hands at rest lie on it; order: what hides what;
    masks: the outlines of people's masks."""


@dataclass(frozen=True)
class ContactsArgs:
    """Which vertices touch something, by POSA's network or files of another tool: contacts.npz."""

    tool: Annotated[Positional[Literal["posa", "files"]], arg(metavar="TOOL")]
    """posa: run the network; files: per-vertex chances (of DECO, POSA), one file or one a frame."""
    bodies: Annotated[Positional[Path], arg(metavar="BODIES")]
    """bodies.npz."""
    source: Path | None = None
    """files: the .npy or .npz file, or the folder of them."""
    first: Index = 0
    """files: the number in the name of the first frame's file."""
    weights: Path | None = None
    """posa: contact.pt or contact_semantics.pt."""
    mesh_folder: Path | None = None
    """posa: the folder mesh_ds."""
    camera: Path | None = None
    """posa: a camera.json with the true pitch and roll, for bodies in camera axes."""
    samples: Annotated[int, int_in(0, 1000)] = 0
    """posa: mean of so many random answers; 0: the one of the mean code."""
    model_folder: Path | None = None
    """Folder of the licensed body models; by default what MOVER_BODY_MODELS names."""
    out: Path = Path("contacts.npz")
    """The file to write."""


def refine(arguments: Sequence[str]) -> None:
    """`mover refine`."""
    args, config = parsed_with(
        RefineArgs, RefineBodiesConfig(), REFINE_SETTINGS, "mover refine", arguments
    )
    import torch

    from mover.app.cli import Bar
    from mover.pipeline.refine import measure_people, refine_result, without

    torch.set_num_threads(1)
    with Bar() as bar:
        found = refine_result(args.out, without(config, args.without), args.capture, bar)
    how = "rigidly" if found.bodies.pose is None else "with their pose"
    way = f"moved by {1000 * float(found.shift.norm(dim=-1).median()):.0f} mm (median)"
    file = args.out / "refined" / "bodies.npz"
    say(f"{len(found.shift)} bodies refined {how}, {way}: {file}")
    values = measure_people(args.out, args.truth)
    say(f"\n{'':20}{'result':>10}{'refined':>10}")
    for name, before in values["result"].items():
        say(f"{name:20}{before:10.4f}{values['refined'][name]:10.4f}")


def contacts(arguments: Sequence[str]) -> None:
    """`mover contacts`."""
    args = parsed(ContactsArgs, "mover contacts", arguments)
    import torch

    from mover.io.capture.bodies_file import read_bodies, read_contacts
    from mover.io.files.fields import write_npz
    from mover.pipeline.refine import find_posa

    if args.model_folder is not None:
        os.environ["MOVER_BODY_MODELS"] = str(args.model_folder)
    people = read_bodies(args.bodies)
    if args.tool == "files":
        chance = read_contacts(_needed(args.source, "--source"), people, args.first)
    else:
        weights = _needed(args.weights, "--weights")
        meshes = _needed(args.mesh_folder, "--mesh-folder")
        chance = find_posa(people, weights, meshes, args.samples, args.camera)
    write_npz({"probability": chance.to(torch.float32).numpy()}, args.out)
    touching = int((chance > 0.5).any(1).sum())
    say(f"{touching} of {len(chance)} bodies touch something: {args.out}")


def _needed(path: Path | None, name: str) -> Path:
    if path is None:
        raise InputError(f"{name}: is missing, expected a path")
    return path
