"""What `import` does."""

import dataclasses
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import parsed
from mover.app.cli.people import tracks_of
from mover.core.errors import InputError
from mover.core.settings import Index, Rate, float_in
from mover.io.formats import IMPORTED, chosen, listing, names

if TYPE_CHECKING:
    from mover.io.capture.merge import Imported
    from mover.io.capture.parts import Hints, Parts
    from mover.io.files.fields import At


FORMATS = f"How the source is written; see docs/your-own-data.md.\n{listing(*IMPORTED)}"


@dataclass(frozen=True)
class ImportArgs:
    """Turn what other tools wrote into a capture folder, part by part.

    A part that is there already stays, unless it is given again. The format `masks` adds masks
    alone. Afterwards the command says what is still missing.
    """

    format: Annotated[Positional[str], arg(metavar="FORMAT", help=FORMATS)]
    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """The file or folder."""
    out: Path
    """The capture folder: new, or one to which this is added."""
    image: Path | None = None
    """The reference image."""
    camera: Path | None = None
    """A calibration: camera.json, transforms of nerfstudio, cam_K.txt, OpenCV's XML, fov.json."""
    fov: Annotated[float, float_in(5, 175)] | None = None
    """Horizontal field of view, where there is no calibration: a guess, which `run` may mend
    [degrees]."""
    objects_masks: Path | None = None
    """Masks of the furniture in the reference image."""
    people_masks: Path | None = None
    """Masks of people in the frames."""
    reference_people: Path | None = None
    """Masks of people who hide furniture in the reference image."""
    bodies: Path | None = None
    """bodies.npz, or what the tool of --bodies-from wrote."""
    bodies_from: str = ""
    """The tool that found the bodies, as gvhmr, wham, tram or smplifyx; else bodies.npz."""
    cameras: Path | None = None
    """Where a moving camera was: cameras.npz, or what the tool of --cameras-from wrote."""
    cameras_from: str = ""
    """The tool that found the poses, as vipe, megasam, colmap or tum; else cameras.npz."""
    reference_frame: Index | None = None
    """The frame that the reference image shows, where the camera moves; else the first pose."""
    gender: str | None = None
    """Of the bodies, where the tool gives none: neutral, female or male."""
    fps: Rate | None = None
    """Frames a second of the people's masks and bodies."""
    tracks: tuple[str, ...] = ()
    """New numbers of the bodies' tracks, as 7=1 0=2; those with one number are one person."""
    up: str = ""
    """Which way is up in a glTF scene or in boxes: y, -y or z."""
    names: tuple[str, ...] = ()
    """Categories of what has only a number or a file name, as 1=chair 2=sofa."""
    recording: str = ""
    """Which recording of a data set (PROX, PiGraphs)."""
    recordings: tuple[str, ...] = ()
    """Several recordings of one room of PROX in one capture; the room's name: all of its own."""
    boxes: Path | None = None
    """bbox3d.json of MOVER's authors: the true furniture of a room of PROX."""


def import_(arguments: Sequence[str]) -> None:
    """`mover import`."""
    args = parsed(ImportArgs, "mover import", arguments)
    chosen("FORMAT", args.format, *IMPORTED)
    with tempfile.TemporaryDirectory(prefix="mover-import-") as work:
        run_import(args, Path(work))


def run_import(args: ImportArgs, work: Path) -> None:
    """Import one source; `work` is a folder for meshes on the way."""
    from mover.io.capture.merge import import_into

    hints = _hints(args, work)
    main: Parts = chosen("FORMAT", args.format, *IMPORTED)(args.source, hints)
    imported = import_into(args.out, *_parts(args, main, hints))
    print_import(imported, args.out)


def _hints(args: ImportArgs, work: Path) -> "Hints":
    """What the options say; a camera of the folder counts where none is given."""
    from mover.io.capture.folder import folder_parts
    from mover.io.capture.parts import Hints
    from mover.io.files.cameras import guessed_view, read_camera_file
    from mover.io.files.images import image_size

    size = None if args.image is None else image_size(args.image)
    camera: At | None = None
    old = folder_parts(args.out) if args.out.is_dir() else None
    if size is None and old is not None:
        size = old.image_size
    if args.camera is not None:
        camera = read_camera_file(args.camera, size)
    elif args.fov is not None:
        if size is None:
            raise InputError("--fov: needs the size of the image, expected --image too")
        camera = guessed_view(args.fov, size)
    elif old is not None:
        camera = old.camera
    if args.recording and args.recordings:
        raise InputError("--recording, --recordings: both are given, expected one of them")
    names = [item.partition("=") for item in args.names]
    for key, equals, value in names:
        if not key or not equals or not value.strip():
            raise InputError(f"--names: has {key + equals + value!r}, expected 1=chair")
    words = {key: value.strip() for key, _, value in names}
    return Hints(
        camera, args.image, args.up, words, args.recording, args.recordings,
        args.boxes, work,
    )  # fmt: skip


def _parts(args: ImportArgs, main: "Parts", hints: "Hints") -> "list[Parts]":
    """The source and what the options add."""
    import numpy as np
    import torch

    from mover.io.capture.bodies_file import read_body_arrays
    from mover.io.capture.parts import Parts, image_parts
    from mover.io.capture.tracks import renumbered
    from mover.io.files.fields import At
    from mover.io.files.npz import read_npz

    found = [main]
    extra = Parts(name=args.out.name)
    if args.camera is not None or args.fov is not None:
        extra = dataclasses.replace(extra, camera=hints.camera)
    if args.image is not None:
        load, size = image_parts(args.image)
        extra = dataclasses.replace(extra, load_image=load, image_size=size)
    if args.bodies is not None:
        bodies = read_body_arrays(args.bodies, args.fps) if not args.bodies_from else None
        if bodies is not None and args.tracks:
            person = renumbered(torch.from_numpy(bodies.get("person").array(("B",), "whole")),
                                tracks_of(args.tracks))  # fmt: skip
            bodies = At({**bodies.value, "person": person.numpy()}, bodies.file)
        bodies = bodies or _bodies_of_tool(args, [*found, extra], hints)
        extra = dataclasses.replace(extra, bodies=bodies)
    if args.cameras is not None:
        tool = args.cameras_from
        if not tool and args.cameras.suffix.lower() != ".npz":
            tools = ", ".join(names("cameras"))
            raise InputError(f"{args.cameras.name}: is no cameras.npz; name its tool "
                             f"(--cameras-from {tools})")  # fmt: skip
        read = chosen("--cameras-from", tool, "cameras") if tool else read_npz
        poses: At = read(args.cameras)
        if args.reference_frame is not None:
            number = np.array(args.reference_frame)
            poses = dataclasses.replace(poses, value={**poses.value, "reference": number})
        extra = dataclasses.replace(extra, cameras=poses)
    return [*found, extra, *_masks(args, [*found, extra], hints)]


def _bodies_of_tool(args: ImportArgs, parts: "Sequence[Parts]", hints: "Hints") -> "At":
    """Bodies of another tool, as the arrays of bodies.npz."""
    from mover.io.capture.bodies_file import bodies_to_arrays
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.fields import At
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known

    assert args.bodies is not None
    chosen("--bodies-from", args.bodies_from, "people")
    lens = next((p.camera for p in reversed(parts) if p.camera is not None), hints.camera)
    camera = None if lens is None else camera_of(lens)
    known = Known(camera, fps=args.fps, gender=args.gender, tracks=tracks_of(args.tracks))
    found = bodies_from(args.bodies_from, args.bodies, known)
    for text in found.warnings:
        say(f"note: {text}")
    return At(bodies_to_arrays(found.bodies), args.bodies.name)


def _masks(args: ImportArgs, parts: "Sequence[Parts]", hints: "Hints") -> "list[Parts]":
    """Masks of the options, in an image of the camera's size; people too where none has a name."""
    from mover.io.capture.parts import Parts
    from mover.io.files.images import image_size
    from mover.io.masks.instance_files import read_people, read_things
    from mover.io.masks.instances import with_reference_people

    camera = next((p.camera for p in reversed(parts) if p.camera is not None), hints.camera)
    size = None if camera is None else (camera.value.get("w"), camera.value.get("h"))
    shape = None if hints.image is None else image_size(hints.image)
    shape = shape or (None if camera is None else size)
    found: list[Parts] = []
    if args.objects_masks is not None:
        picture = "" if args.image is None else args.image.name
        masks = read_things(args.objects_masks, hints.names, shape, picture, fit=size)
        tree = masks.objects_tree()
        found.append(Parts(name="", objects=tree, notes=masks.notes))
    if args.people_masks is not None:
        masks = read_people(args.people_masks, hints.names, shape, size)
        found.append(Parts(name="", people=masks.people_tree(args.fps), notes=masks.notes))
    if args.reference_people is not None:
        masks = read_things(args.reference_people, hints.names, shape, fit=size, people=True)
        people = next((p.people for p in reversed([*parts, *found]) if p.people is not None), None)
        tree = with_reference_people(people, masks, args.out)
        found.append(Parts(name="", people=tree, notes=masks.notes))
    return found


def print_import(imported: "Imported", folder: Path) -> None:
    """Say what the capture has and what it lacks."""
    from mover.io.capture.evidence import evidence_table, gather_evidence
    from mover.io.capture.faults import check_against_picture

    say(f"{folder}: wrote {', '.join(imported.written) or 'nothing'}")
    for note in imported.notes:
        say(f"note: {note}")
    capture = imported.capture
    if capture is not None:
        say(evidence_table(capture, gather_evidence(capture)))
        for warning in check_against_picture(capture).warnings:
            say(f"warning: {warning}")
    for text in imported.missing:
        say(f"still missing: {text}")
    if capture is not None:
        say(f"next: mover check {folder}; mover run {folder} --out OUT")
