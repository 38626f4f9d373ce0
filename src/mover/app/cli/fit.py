"""What `fit` does."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed, preset_of
from mover.app.cli.console import say
from mover.core.errors import InputError
from mover.core.settings import Index, Rate, float_in
from mover.fitting.config import FitConfig
from mover.fitting.presets import FITS

NO_VPOSER = "note: the printed pose prior is VPoser's; without --vposer ours stands in for it"
Detector = Literal["openpose", "coco17", "halpe26", "wholebody"]


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
    """VPoser's weights (a checkpoint, its folder, or .npz) instead of the ranges of motion."""
    preset: Literal["robust", "paper"] = "robust"
    """How bodies are priced: ours, or E_Body as printed, with VPoser's weights (--vposer)."""
    ground: Annotated[float, float_in(-100, 100)] | None = None
    """Height of the floor in the camera's world, where it is known: nobody sinks into it [m]."""
    fps: Rate | None = None
    """Frames a second, where the keypoints do not tell."""
    first: Index = 0
    """The number in the name of the first frame's file, 1 where they count from 1."""
    one_euro: bool = False
    """Filter the keypoints over time before the fit (One-Euro)."""
    drop: bool = False
    """Leave out bodies that no person can have been (the filter of `mover run`)."""


def fit(arguments: Sequence[str]) -> None:
    """`mover fit`."""
    preset = preset_of(arguments, tuple(FITS))

    def both(
        args: Annotated[FitArgs, arg(name="")],
        config: Annotated[FitConfig, arg(name="")] = FITS[preset],
    ) -> tuple[FitArgs, FitConfig]:
        """Fit bodies to the 2D joints of a video: keypoints.npz, or what a detector wrote."""
        return args, config

    fit_into(*parsed(both, "mover fit", arguments))


def fit_into(args: FitArgs, config: FitConfig | None = None) -> None:
    """Fit, and write the bodies.

    Args:
        args: What to fit.
        config: Weights and settings; None: the preset's.

    Raises:
        InputError: If what is given cannot be used.
    """
    from mover.app.cli.progress import Bar
    from mover.bodies import load_model
    from mover.fitting.bodies import FitInputs, fit_bodies
    from mover.fitting.one_euro import smooth_keypoints
    from mover.fitting.prior import prior_of
    from mover.io.capture.bodies_file import read_bodies, write_bodies

    if args.model_folder is not None:
        os.environ["MOVER_BODY_MODELS"] = str(args.model_folder)
    keypoints = keypoints_at(args.source, args.tool, args.fps, args.first)
    camera, ground = _world(args)
    inputs = FitInputs(
        keypoints=smooth_keypoints(keypoints) if args.one_euro else keypoints,
        camera=camera,
        model=load_model(args.model, args.gender),  # pyright: ignore[reportArgumentType]
        start=None if args.start is None else read_bodies(args.start),
        prior=prior_of(args.vposer),
        ground=ground,
    )
    if args.preset == "paper" and args.vposer is None:
        say(NO_VPOSER)
    with Bar() as bar:
        found = fit_bodies(inputs, config or FITS[args.preset], observe=bar)
    for warning in found.warnings:
        say(f"warning: {warning}")
    bodies = _without_outliers(found.bodies) if args.drop else found.bodies
    write_bodies(bodies, args.out)
    people, frames = len(bodies.person.unique()), len(bodies.frame.unique())
    miss = float(found.miss.mean())
    say(f"{people} people in {frames} frames, keypoints missed by {miss:.1f} px: {args.out}")


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


def keypoints_at(source: Path, tool: str, fps: float | None, first: int) -> Any:  # noqa: ANN401
    """The 2D joints of keypoints.npz, or of a detector's file or folder.

    Raises:
        InputError: If they cannot be read.
    """
    from mover.io.people.found import Known
    from mover.io.people.keypoints import keypoints_from, read_keypoints

    if source.suffix != ".npz":
        return keypoints_from(tool, source, Known(fps=fps, first=first))
    found = read_keypoints(source)
    return found if fps is None else replace(found, fps=fps)


def _without_outliers(bodies: Any) -> Any:  # noqa: ANN401
    """The rows that the frame filter keeps."""
    from mover.core.records import rows_of
    from mover.stages.people.select_frames import SelectInputs, select_frames

    keep = select_frames(SelectInputs(bodies)).keep
    say(f"{int((~keep).sum())} of {len(keep)} bodies are left out by the frame filter")
    return rows_of(bodies, keep)
