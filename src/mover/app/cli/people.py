"""What `import-bodies` and `fit` do."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mover.app.cli import say
from mover.app.cli.config import chosen_config, parsed, parsed_with
from mover.core.errors import InputError
from mover.core.settings import Index, Rate, float_in
from mover.fitting import FITS, FitConfig
from mover.io.formats import chosen, listing, names

TOOLS = f"The tool that wrote the source; see docs/data.md.\n{listing('people', 'keypoints')}"


@dataclass(frozen=True)
class BodiesArgs:
    """Turn what another tool found of people into bodies.npz, or keypoints.npz for 2D joints."""

    tool: Annotated[Positional[str], arg(metavar="TOOL", help=TOOLS)]
    source: Annotated[Positional[Path], arg(metavar="SOURCE")]
    """Its file or folder."""
    out: Path | None = None
    """The file to write: bodies.npz, or keypoints.npz."""
    camera: Path | None = None
    """The true lens (camera.json or a calibration): bodies keep their pixels under it."""
    focal: Annotated[float, float_in(1, 1e6)] | None = None
    """The focal length that the tool assumed, where its files do not give it [px]."""
    model_folder: Path | None = None
    """Folder of the licensed body models; by default what MOVER_BODY_MODELS names."""
    faces: Path | None = None
    """A mesh file with the triangles of the bodies, for meshes without a model."""
    gender: Literal["neutral", "female", "male"] | None = None
    """Of the body model; by default what the files say, else neutral."""
    fps: Rate | None = None
    """Frames a second."""
    first: Index = 0
    """The number in the name of the first frame's file, 1 where they count from 1."""
    vposer: Path | None = None
    """VPoser's weights (a checkpoint or its folder), for codes that SMPLify-X stored."""
    tracks: tuple[str, ...] = ()
    """New numbers of tracks, as 4=0 17=0; those with one number are one person."""


def bodies(arguments: Sequence[str]) -> None:
    """`mover import-bodies`."""
    args = parsed(BodiesArgs, "mover import-bodies", arguments)
    if args.model_folder is not None:
        os.environ["MOVER_BODY_MODELS"] = str(args.model_folder)
    chosen("TOOL", args.tool, "people", "keypoints")
    from mover.io.capture.bodies_file import odd_bodies, write_bodies
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.cameras import read_camera_file
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known
    from mover.io.people.keypoints import keypoints_from, write_keypoints

    camera = None if args.camera is None else camera_of(read_camera_file(args.camera, None))
    tracks = tracks_of(args.tracks)
    known = Known(camera, args.focal, args.faces, args.fps, args.gender, args.first, tracks=tracks)
    if args.vposer is not None:
        from mover.fitting.unknowns import load_vposer, vposer_prior

        known = replace(known, decode=vposer_prior(load_vposer(args.vposer)).decode)
    if args.tool in names("keypoints"):
        joints = keypoints_from(args.tool, args.source, known)
        out = args.out or Path("keypoints.npz")
        write_keypoints(joints, out)
        say(f"{len(joints.frame)} rows, {_counted(joints)}, joints: {joints.layout}: {out}")
        return
    found = bodies_from(args.tool, args.source, known)
    people, out = found.bodies, args.out or Path("bodies.npz")
    write_bodies(people, out)
    odd = [f"{args.source.name}: {text}" for text in odd_bodies(people)]
    for warning in (*found.warnings, *odd):
        say(f"warning: {warning}")
    model = "meshes only" if people.pose is None else f"parameters of {people.pose.model}"
    rows = f"{len(people.frame)} rows, {_counted(people)}"
    say(f"{rows}, {people.verts.shape[1]} vertices, {model}: {out}")


def tracks_of(given: Sequence[str]) -> dict[int, int]:
    """`4=0` as a table."""
    if odd := [text for text in given if not re.fullmatch("[0-9]{1,8}=[0-9]{1,8}", text)]:
        raise InputError(f"--tracks: has {odd[0]!r}, expected old and new number as 4=0")
    return {int(old): int(new) for old, _, new in (text.partition("=") for text in given)}


def _counted(found: Any) -> str:  # noqa: ANN401
    """`2 people in 6 frames`."""
    return f"{len(found.person.unique())} people in {len(found.frame.unique())} frames"


OUTSIDE = 0.5  # share of joints beyond the image: those of another size
NO_VPOSER = "note: the printed pose prior is VPoser's; without --vposer ours stands in for it"
Detector = Literal["openpose", "coco17", "halpe26"]


@dataclass(frozen=True)
class FitArgs:
    """Fit bodies to the 2D joints of a video: keypoints.npz, or what a detector wrote."""

    source: Annotated[Positional[Path], arg(metavar="KEYPOINTS")]
    """keypoints.npz, or a file or folder of a detector."""
    camera: Path | None = None
    """The true lens (camera.json or a calibration); its pitch and roll are a first guess."""
    room: Path | None = None
    """The result of `mover run`, for a second pass: its camera and its floor count (Sec. 3.2)."""
    out: Path = Path("bodies.npz")
    """The file to write."""
    tool: Detector = "openpose"
    """The detector, where the source is not keypoints.npz."""
    model: Literal["makehuman", "smpl", "smplh", "smplx"] = "makehuman"
    """The body model; all but the open body need the user's files."""
    gender: Literal["neutral", "female", "male"] = "neutral"
    """Of the body model."""
    model_folder: Path | None = None
    """Folder of the licensed body models; by default what MOVER_BODY_MODELS names."""
    start: Path | None = None
    """bodies.npz to start from: parameters of any model, or joints, in the camera frame."""
    vposer: Path | None = None
    """VPoser's weights (a checkpoint or its folder) instead of the ranges of motion."""
    preset: Literal["robust", "paper"] = "robust"
    """The weights: ours, or E_Body as printed, with VPoser's weights (--vposer)."""
    ground: Annotated[float, float_in(-100, 100)] | None = None
    """Height of the floor in the camera's world, where it is known: people stand on it [m]."""
    height: tuple[Annotated[float, float_in(0.4, 2.6, "metres")], ...] = ()
    """Heights of the people, one for all or one each in the order of their numbers [m]."""
    fps: Rate | None = None
    """Frames a second, where the keypoints give none."""
    first: Index = 0
    """The number in the name of the first frame's file, 1 where they count from 1."""
    drop: bool = False
    """Leave out bodies that no person can have been (the filter of `mover run`)."""


def fit(arguments: Sequence[str]) -> None:
    """`mover fit`."""
    fit_into(*parsed_with(FitArgs, chosen_config(arguments, FITS), {}, "mover fit", arguments))


def fit_into(args: FitArgs, config: FitConfig | None = None) -> None:
    """Fit, with the preset's settings where none are given, and write the bodies.

    Raises:
        InputError: If what is given cannot be used.
    """
    from mover.app.cli import Bar
    from mover.bodies import load_model
    from mover.core.records import rows_of
    from mover.fitting.bodies import FitInputs, fit_bodies
    from mover.fitting.unknowns import prior_of
    from mover.io.capture.bodies_file import read_bodies, write_bodies
    from mover.pipeline.estimates import poor_fits
    from mover.stages.people.select_frames import select_frames

    if args.model_folder is not None:
        os.environ["MOVER_BODY_MODELS"] = str(args.model_folder)
    camera, ground = _world(args)
    joints = _keypoints(args)
    x, y = joints.points[joints.confidence > 0].unbind(-1)
    outside = (x > camera.width) | (y > camera.height) | (x < 0) | (y < 0)
    if len(x) and (float(outside.double().mean()) > OUTSIDE or float(x.max()) <= 1):
        reach = f"reach from ({x.min():.4g}, {y.min():.4g}) to ({x.max():.4g}, {y.max():.4g})"
        size = f"pixels of the camera's image of {camera.width} x {camera.height}"
        raise InputError(f"{args.source.name}: keypoints {reach}, expected {size}; are they of "
                         "another size of the video?")  # fmt: skip
    inputs = FitInputs(
        keypoints=joints,
        camera=camera,
        model=load_model(args.model, args.gender),  # pyright: ignore[reportArgumentType]
        start=None if args.start is None else read_bodies(args.start),
        prior=prior_of(args.vposer),
        ground=ground,
        heights=args.height,
    )
    if args.preset == "paper" and args.vposer is None:
        say(NO_VPOSER)
    with Bar() as bar:
        found = fit_bodies(inputs, config or FITS[args.preset], observe=bar)
    bodies = found.bodies
    for warning in (*found.warnings, *poor_fits(bodies, found.miss, camera)):
        say(f"warning: {warning}")
    if args.drop:
        keep = select_frames(bodies).keep
        say(f"{int((~keep).sum())} of {len(keep)} bodies are left out by the frame filter")
        bodies = rows_of(bodies, keep)
    write_bodies(bodies, args.out)
    miss = float(found.miss.mean())
    say(f"{_counted(bodies)}, keypoints missed by {miss:.1f} px: {args.out}")


def _world(args: FitArgs) -> tuple[Any, float | None]:
    """The camera, and the height of the floor where it is known."""
    from mover.io.capture.camera_file import camera_of
    from mover.io.capture.scene_file import read_scene
    from mover.io.files.cameras import read_camera_file

    if (args.camera is None) == (args.room is None):
        raise InputError("fit: expected --camera or --room, one of the two")
    if args.camera is not None:
        return camera_of(read_camera_file(args.camera, None)), args.ground
    assert args.room is not None
    scene = read_scene(args.room / "scene.json")
    return scene.camera, scene.ground if args.ground is None else args.ground


def _keypoints(args: FitArgs) -> Any:  # noqa: ANN401
    """The 2D joints of keypoints.npz, or of a detector's file or folder."""
    from mover.io.people.found import Known
    from mover.io.people.keypoints import keypoints_from, read_keypoints

    if args.source.suffix != ".npz":
        return keypoints_from(args.tool, args.source, Known(fps=args.fps, first=args.first))
    found = read_keypoints(args.source)
    return found if args.fps is None else replace(found, fps=args.fps)
