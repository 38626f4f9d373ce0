"""What `refine` and `contacts` do."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import REFINE_SETTINGS, parsed, parsed_with
from mover.core.errors import InputError
from mover.core.settings import Index, int_in
from mover.stages.config import RefineBodiesConfig


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

    from mover.app.cli.progress import Bar
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
    from mover.io.files.npz import write_npz
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
