"""What `import` does."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
    tilt: tuple[Annotated[float, float_in(-180, 180)], ...] = ()
    """Pitch (below 0: looks down), roll and, if not 1, how far off they may be, where a level or a
    phone measured them (photos of an iPhone say it) [degrees]."""
    camera_height: Annotated[float, float_in(0.1, 20)] | None = None
    """Height of the camera above the floor, where it was measured [m]."""
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
    run_import(parsed(ImportArgs, "mover import", arguments))


def run_import(args: ImportArgs) -> None:
    """Import one source, and say what the capture has and lacks."""
    read = chosen("FORMAT", args.format, *IMPORTED)
    from mover.io.capture.merge import import_into

    if args.format == "folder" and not args.source.is_dir() and args.source != args.out:
        what = "is a file" if args.source.exists() else "there is no such folder"
        raise InputError(f"{args.source}: {what}, expected a capture")
    if args.up and args.format not in ("glb", "boxes"):
        raise InputError(
            f"--up: is for glb and boxes, not for {args.format}; 'mover check CAPTURE --mend NEW'"
            " turns what lies on its side"
        )
    with tempfile.TemporaryDirectory(prefix="mover-import-") as work:  # of meshes on the way
        hints = _hints(args, Path(work))
        main: Parts = read(args.source, hints)
        _print_import(import_into(args.out, *_parts(args, main, hints)), args.out)


def _hints(args: ImportArgs, work: Path) -> "Hints":
    """What the options say; a camera of the folder counts where none is given."""
    from mover.io.capture.folder import folder_parts
    from mover.io.capture.parts import Hints, Parts
    from mover.io.files.cameras import camera_of_photo, guessed_view, read_camera_file
    from mover.io.files.images import image_size

    old = folder_parts(args.out) if args.out.is_dir() else Parts(name="")
    size = old.image_size if args.image is None else image_size(args.image)
    camera = old.camera
    if args.camera is not None:
        camera = read_camera_file(args.camera, size)
    elif args.fov is not None:
        if size is None:
            raise InputError("--fov: needs the size of the image, expected --image too")
        camera = guessed_view(args.fov, size)
    elif camera is None and args.image is not None:
        camera = camera_of_photo(args.image, size)
    elif camera is not None and args.image is not None and size is not None:
        sides = camera.get("w").value, camera.get("h").value
        if sides != size:
            found = f"is of pictures of {sides[0]} x {sides[1]} pixels, {args.image.name}"
            cure = "one size: --camera FILE scales a lens to the image"
            raise InputError(f"{camera.file}: {found} has {size[0]} x {size[1]}, expected {cure}")
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

    from mover.io.capture.parts import Parts, image_parts
    from mover.io.files.cameras import with_known
    from mover.io.files.fields import read_npz

    given, extra = args.camera is not None or args.fov is not None, dict[str, Any]()
    lens = hints.camera if given else main.camera or hints.camera
    if lens is None and (args.tilt or args.camera_height is not None):
        raise InputError("--tilt, --camera-height: there is no lens (--camera FILE, --fov DEGREES)")
    if lens is not None:
        own, lens = lens, with_known(lens, args.tilt, args.camera_height, args.image)
        if given or lens.value != own.value or not (args.out / "camera.json").is_file():
            extra["camera"] = lens
    if args.image is not None:
        extra["load_image"], extra["image_size"] = image_parts(args.image)
    if args.bodies is not None:
        extra["bodies"] = _bodies(args, args.bodies, lens)
    if args.cameras is not None:
        tool = args.cameras_from
        if not tool and args.cameras.suffix.lower() != ".npz":
            tools = ", ".join(names("cameras"))
            raise InputError(f"{args.cameras.name}: is no cameras.npz; name its tool "
                             f"(--cameras-from {tools})")  # fmt: skip
        read = chosen("--cameras-from", tool, "cameras") if tool else read_npz
        poses: At = read(args.cameras)
        if args.reference_frame is not None:
            poses = poses.holding({**poses.value, "reference": np.array(args.reference_frame)})
        extra["cameras"] = poses
    return [main, Parts(name=args.out.name, **extra), *_masks(args, main, lens, hints)]


def _bodies(args: ImportArgs, file: Path, lens: "At | None") -> "At":
    """The arrays of bodies.npz: of the file itself, or of the tool that wrote it."""
    import torch

    from mover.io.capture.bodies_file import bodies_to_arrays, read_body_arrays
    from mover.io.capture.camera_file import camera_of
    from mover.io.capture.tracks import renumbered
    from mover.io.files.fields import At
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known

    if not args.bodies_from:
        own = read_body_arrays(file, args.fps)
        if not args.tracks:
            return own
        person = torch.from_numpy(own.get("person").array(("B",), "whole"))
        person = renumbered(person, tracks_of(args.tracks)).numpy()
        return own.holding({**own.value, "person": person})
    chosen("--bodies-from", args.bodies_from, "people")
    camera = None if lens is None else camera_of(lens)
    known = Known(camera, fps=args.fps, gender=args.gender, tracks=tracks_of(args.tracks))
    found = bodies_from(args.bodies_from, file, known)
    for text in found.warnings:
        say(f"note: {text}")
    return At(bodies_to_arrays(found.bodies), file.name)


def _masks(args: ImportArgs, main: "Parts", lens: "At | None", hints: "Hints") -> "list[Parts]":
    """Masks of the options, in an image of the camera's size; people too where none has a name."""
    from mover.io.capture.parts import Parts
    from mover.io.files.images import image_size
    from mover.io.masks.instance_files import read_people, read_things
    from mover.io.masks.instances import with_reference_people

    size = None if lens is None else (lens.value.get("w"), lens.value.get("h"))
    shape = size if hints.image is None else image_size(hints.image)
    found, people = list[Parts](), main.people
    if args.objects_masks is not None:
        picture = "" if args.image is None else args.image.name
        masks = read_things(args.objects_masks, hints.names, shape, picture, fit=size)
        found.append(Parts(name="", objects=masks.objects_tree(), notes=masks.notes))
    if args.people_masks is not None:
        masks = read_people(args.people_masks, hints.names, shape, size)
        people = masks.people_tree(args.fps)
        found.append(Parts(name="", people=people, notes=masks.notes))
    if args.reference_people is not None:
        masks = read_things(args.reference_people, hints.names, shape, fit=size, people=True)
        people = with_reference_people(people, masks, args.out)
        found.append(Parts(name="", people=people, notes=masks.notes))
    return found


def _print_import(imported: "Imported", folder: Path) -> None:
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
