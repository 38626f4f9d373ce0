"""What `video` and `image` do: the whole way in one command."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mover.app.chain import FIT, BodiesFrom, Steps, make_bodies, steps_in
from mover.app.cli.config import Device, parsed, preset_named
from mover.app.cli.console import say
from mover.app.cli.fit import FitArgs, fit_into
from mover.app.cli.perceive import (
    LayoutArgs,
    PerceiveArgs,
    layout_into,
    perceive_into,
    ready_models,
)
from mover.core.errors import InputError
from mover.core.settings import float_in
from mover.perceive.config import PerceiveConfig

STEPS = ("pictures", "bodies", "first scene", "room")
ONE_IMAGE = (
    "note: one picture shows one moment: nobody passes behind furniture, nothing is touched twice, "
    "nobody's height is averaged; a video of ten seconds or more places furniture far better"
)


@dataclass(frozen=True)
class ChainArgs:
    """What both commands ask."""

    out: Path
    """Folder for the capture (OUT/capture) and the room (OUT/room); a run that was killed goes on
    there."""
    bodies: str = FIT
    """fit: by the open body, to the keypoints; or a FILE; or a COMMAND of a body network with
    {video}, {frames}, {camera} and {out} in it."""
    bodies_tool: str = ""
    """What wrote FILE, or what COMMAND writes: a TOOL of `mover import-bodies`; empty: bodies.npz
    itself."""
    camera: Path | None = None
    """A calibration; GeoCalib's also tells pitch and roll."""
    fov: Annotated[float, float_in(1, 179)] | None = None
    """Horizontal field of view, where there is no calibration [degrees]."""
    photo: Path | None = None
    """A photo of the same camera, whose EXIF tells the focal length."""
    depth: Path | None = None
    """Metric depth of the reference picture, for the first scene and the room."""
    meshes: Path | None = None
    """Folder with your own shapes, named after their class: chair_0.obj."""
    weights: Path | None = None
    """Folder with the networks, for a machine without a network: one folder for each."""
    preset: str = "robust"
    """Settings of the room: paper, release or robust."""
    device: Device = "cpu"
    """Where the room is computed: cpu, cuda or auto."""
    refine: bool = True
    """Refine the people with the room at the end."""
    config: Annotated[PerceiveConfig, arg(name="")] = field(default_factory=PerceiveConfig)


@dataclass(frozen=True)
class VideoArgs:
    """From a video to a room: pictures, bodies, first scene, room, report."""

    source: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """A video, or a folder of pictures."""
    chain: Annotated[ChainArgs, arg(name="")]


@dataclass(frozen=True)
class ImageArgs:
    """From one picture to a room; the command says what one picture cannot give."""

    source: Annotated[Positional[Path], arg(metavar="IMAGE")]
    """A picture with people and furniture in it."""
    chain: Annotated[ChainArgs, arg(name="")]


def video(arguments: Sequence[str]) -> None:
    """`mover video`."""
    args = parsed(VideoArgs, "mover video", arguments)
    if not args.source.exists():
        raise InputError(f"{args.source}: there is no such file, expected a video or a folder")
    video_to_room(args.source, args.chain)


def image(arguments: Sequence[str]) -> None:
    """`mover image`."""
    args = parsed(ImageArgs, "mover image", arguments)
    from mover.perceive.video import read_picture

    if not args.source.is_file():
        raise InputError(f"{args.source}: there is no such file, expected a picture")
    read_picture(args.source)
    folder = args.chain.out / "picture"
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / args.source.name
    if not place.exists() or place.read_bytes() != args.source.read_bytes():
        place.write_bytes(args.source.read_bytes())
    say(ONE_IMAGE)
    video_to_room(folder, args.chain)


def video_to_room(
    source: Path,
    args: ChainArgs,
    finders: Any = None,  # noqa: ANN401
) -> None:
    """All steps; what cannot work is said before the first.

    Args:
        source: A video, or a folder of pictures.
        args: What is asked.
        finders: What stands for the networks, `perceive.capture.Finders`; None: they themselves.

    Raises:
        InputError: If something is missing, or there is no furniture.
    """
    from mover.perceive.video import stamp_of

    config = _checked(args, finders is None)
    capture, steps = args.out / "capture", steps_in(args.out, say, STEPS)
    stamp = str((str(source.resolve()), *stamp_of(source)))
    lens = args.camera, args.fov, args.photo
    pictures = PerceiveArgs(source, capture, *lens, config=config)
    seen = [stamp, repr(config), *map(str, lens)]
    steps.do(
        STEPS[0],
        seen,
        capture / "objects.json",
        lambda: perceive_into(pictures, config.models, finders),
    )
    _tell_what_is_missing(capture)
    _bodies(source, capture, args, steps)
    _first_scene(capture, args, steps)
    _room(capture, args)


def _checked(args: ChainArgs, networks: bool) -> PerceiveConfig:
    """The settings, with all that is missing on this machine said at once."""
    preset_named(args.preset)
    BodiesFrom(args.bodies, args.bodies_tool).check()
    models = args.config.models
    return replace(args.config, models=ready_models(models, args.weights) if networks else models)


def _tell_what_is_missing(capture: Path) -> None:
    """No furniture ends the way; no people is a warning.

    Raises:
        InputError: If the picture shows no furniture.
    """
    import json

    if not json.loads((capture / "objects.json").read_text())["annotations"]:
        raise InputError(
            f"{capture / 'reference.png'}: the network finds no furniture in it, so there is "
            "nothing to place; --detect.score 0.3 hears weaker finds"
        )
    if not json.loads((capture / "people.json").read_text())["annotations"]:
        say("warning: nobody is seen in the video: only the image places the furniture")


def _bodies(source: Path, capture: Path, args: ChainArgs, steps: Steps) -> None:
    """bodies.npz, where somebody is seen."""
    bodies, keypoints = BodiesFrom(args.bodies, args.bodies_tool), capture / "keypoints.npz"
    if args.bodies == FIT and not keypoints.is_file():
        say("warning: no keypoints were found, so there are no bodies")
        steps.undo(STEPS[1], capture / "bodies.npz")
        return
    given = [] if args.bodies == FIT or bodies.is_command else [Path(args.bodies)]
    made_from = [keypoints, lens_in(capture), args.bodies, args.bodies_tool, *given]

    def work() -> None:
        make_bodies(bodies, source, capture, lambda: _fit(capture))

    steps.do(STEPS[1], made_from, capture / "bodies.npz", work, yours=args.bodies == FIT)


def _first_scene(capture: Path, args: ChainArgs, steps: Steps) -> None:
    """scene.json, under the camera that the bodies tell."""
    from mover.io.files.depth import find_depth_file

    names = ("objects.json", "people.json", "bodies.npz")
    made_from = [*(capture / name for name in names), lens_in(capture)]
    own = find_depth_file(capture) if args.depth is None else (args.depth, True)
    made_from += [str(args.meshes), *([] if own is None else [own[0]])]
    asked = LayoutArgs(capture, args.depth, args.meshes)
    made = capture / "scene.json"
    steps.do(STEPS[2], made_from, made, lambda: layout_into(asked), yours=True)


def lens_in(capture: Path) -> str:
    """What camera.json says of the lens: the tilt beside it is found with the first scene."""
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.cameras import read_camera_file

    camera = camera_of(read_camera_file(capture / "camera.json", None))
    return f"{camera.width} {camera.height} " + " ".join(f"{v:.6g}" for v in camera.K.flatten())


def _fit(capture: Path) -> None:
    made = capture / "bodies.npz"
    fit_into(FitArgs(capture / "keypoints.npz", capture / "camera.json", out=made, drop=True))


def _room(capture: Path, args: ChainArgs) -> None:
    """The room and its report; its own stages are kept by themselves."""
    from mover.app.cli.run import reconstruct_into
    from mover.app.results import Origin
    from mover.core.devices import device_of
    from mover.io.formats import read

    say(f"{len(STEPS)}/{len(STEPS)} {STEPS[-1]} ...")
    people: Any = (capture / "bodies.npz").is_file() and args.refine
    origin = Origin(str(capture.resolve()), refine=people, device=device_of(args.device))
    reconstruct_into(args.out / "room", read("folder", capture), preset_named(args.preset), origin)
    say(f"report: {args.out / 'room' / 'report.html'}")
