"""What `layout` does, and `video`: the whole way in one command."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from mover.app import chain
from mover.app.cli import config as flags
from mover.app.cli import say
from mover.app.cli.people import FitArgs, fit_into
from mover.app.cli.run import THREADS, reconstruct_into
from mover.core.errors import InputError
from mover.core.files import not_there, unreadable
from mover.core.settings import Index, float_in
from mover.perceive.config import PICTURES, LayoutConfig, PerceiveConfig, missing
from mover.pipeline.presets import PRESETS

if TYPE_CHECKING:
    from mover.perceive.capture import Finders
    from mover.perceive.own import Video

NETWORK, MEDIAPIPE = "network", "mediapipe"


@dataclass(frozen=True)
class LayoutArgs:
    """Find a first scene: furniture of the library (or yours) where the picture shows some.

    Needs camera.json and objects.json in the capture, and is far better with bodies.npz, whose feet
    show where the floor is; writes scene.json, meshes/ and hypotheses.json.
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """The capture folder."""
    depth: Path | None = None
    """Metric depth of the reference picture (.npz, .npy [m], 16-bit .png [mm]): a copy goes into
    the capture, for `mover run`, too."""
    meshes: Path | None = None
    """Folder with your own shapes, named after their class: chair_0.obj."""


def layout(arguments: Sequence[str]) -> None:
    """`mover layout`."""
    settings = LayoutConfig(), flags.LAYOUT_SETTINGS
    args, config = flags.parsed_with(LayoutArgs, *settings, "mover layout", arguments)
    layout_into(args, config)
    say(f"next: mover check {args.capture}; mover run {args.capture} --out OUT")


def take_depth(depth: Path, capture: Path) -> None:
    """A copy of a measured depth becomes the capture's own, for `mover run`, too.

    Raises:
        InputError: If there is no such file, or the capture has an inverse depth.
    """
    from mover.core.files import copy_whole
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.fields import read_json
    from mover.io.files.images import DEPTH, find_depth_file, read_depth, reference_frame

    if not depth.is_file():
        cure = ": name the file of the reference picture in it" if depth.is_dir() else ""
        raise InputError(f"{depth}: {not_there(depth)}, expected a depth map{cure}")
    if not capture.is_dir():
        raise InputError(f"{capture}: there is no such folder, expected a capture")
    place = capture / DEPTH / f"000000{depth.suffix.lower()}"
    if (capture / "camera.json").is_file():  # so that what is wrong is named by the user's file
        read_depth(depth, camera_of(read_json(capture / "camera.json")),
                   frame=reference_frame(capture))  # fmt: skip
    if depth.resolve() != place.resolve():
        for old in (capture / DEPTH).glob("000000.*"):
            old.unlink()
        copy_whole(depth, place)
    find_depth_file(capture)


def layout_into(args: LayoutArgs, config: LayoutConfig) -> None:
    """Write the first scene into the capture."""
    import torch

    from mover.app.cli import Bar
    from mover.core.run import Run
    from mover.furniture.library import unknown_names
    from mover.io.capture.bodies_file import read_bodies
    from mover.perceive.capture import read_picture_of, write_first_scene
    from mover.perceive.layout import first_scene
    from mover.perceive.standing import seen_from

    torch.set_num_threads(THREADS)
    if args.depth is not None:
        take_depth(args.depth, args.capture)
    picture, people = read_picture_of(args.capture), args.capture / "bodies.npz"
    guess = picture
    with Bar() as bar:
        run = Run(args.capture / "perceived", bar)
        picture = seen_from(picture, read_bodies(people) if people.is_file() else None, run)
        first = first_scene(picture, config, run, args.meshes)
    write_first_scene(first, args.capture, guess)
    ground = first.scene.ground
    height = "" if ground is None else f", camera {-ground:.2f} m above the floor"
    if unknown := unknown_names(one.category for one in picture.detections):
        say(f"warning: {unknown}")
    say(f"{args.capture}: first scene of {len(first.scene.objects)} objects{height}")
    if first.skipped:
        say(f"note: not on the floor, left out: {', '.join(sorted(set(first.skipped)))}")


@dataclass(frozen=True)
class WeightsArgs:
    """Bring MediaPipe's two networks of people's poses (Apache-2.0) into the cache folder."""

    name: Annotated[Positional[Literal["mediapipe"]], arg(metavar="mediapipe")]
    """What is brought."""
    file: Annotated[Positional[Path | None], arg(metavar="FILE")] = None
    """The wheel of mediapipe, pose_landmarker_*.task, or another landmark network .tflite (heavy)
    that is there; without it, pip downloads the wheel."""


def bring_weights(arguments: Sequence[str]) -> None:
    """`mover weights`."""
    from mover.perceive.config import fetch

    args = tyro.cli(WeightsArgs, prog="mover weights", args=list(arguments))
    fetch(say, args.file)


# The whole way in one command.


STEPS = ("pictures", "bodies", "first scene", "room")
ONE_IMAGE = (
    "note: one picture shows one moment: no person passes behind furniture, nothing is touched "
    "twice, no height is averaged; a video of ten seconds or more places furniture far better"
)


@dataclass(frozen=True)
class VideoArgs:
    """From a video to a room: pictures, bodies, first scene, room, report."""

    source: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """A video, a folder of pictures, or one picture."""
    out: Path
    """Folder for the capture (OUT/capture) and the room (OUT/room); a run that was killed goes on
    there."""
    keypoints: str = NETWORK
    """People's joints: network (ViTPose); mediapipe (masks, too); a FILE of joints in the video; or
    a COMMAND with {video} or {frames}, and {out}, in it."""
    people_masks: Path | None = None
    """People's masks in the video: COCO, pictures, arrays."""
    objects: Path | None = None
    """Outlines or boxes of furniture (labelme, COCO) in OUT/capture/reference.png, or in a frame
    of the video."""
    objects_frame: Index | None = None
    """The number of that frame, from 0."""
    bodies: str = chain.FIT
    """fit: by the open body, to the keypoints; or a FILE; or a COMMAND of a body network with
    {video}, {frames}, {camera} and {out} in it."""
    bodies_tool: str = ""
    """What wrote FILE, or what COMMAND writes: a TOOL of `mover import-bodies`; empty: bodies.npz
    itself."""
    height: tuple[Annotated[float, float_in(0.4, 2.6, "metres")], ...] = ()
    """How tall people are, one for all or for each in the order of their numbers [m]: gives
    `--bodies fit` and the room how far they are."""
    camera: Path | None = None
    """A calibration (GeoCalib's also has pitch and roll), or a photo of the same camera, whose EXIF
    has the focal length."""
    fov: Annotated[float, float_in(5, 175)] | None = None
    """Horizontal field of view, where there is no calibration [degrees]."""
    tilt: tuple[Annotated[float, float_in(-180, 180)], ...] = ()
    """Pitch (below 0: looks down), roll and, if not 1, how far off they may be, where a level or a
    phone measured them [degrees]."""
    camera_height: Annotated[float, float_in(0.1, 20)] | None = None
    """Height of the camera above the floor, where it was measured [m]."""
    depth: Path | None = None
    """Metric depth of the reference picture, for the first scene and the room."""
    meshes: Path | None = None
    """Folder with your own shapes, named after their class: chair_0.obj."""
    preset: str = "robust"
    """Settings of the room: paper, printed or robust."""
    device: flags.Device = "cpu"
    """Where the room is computed: cpu, cuda or auto."""


def video(arguments: Sequence[str]) -> None:
    """`mover video`."""
    settings = PerceiveConfig(), flags.PERCEIVE_SETTINGS
    args, config = flags.parsed_with(VideoArgs, *settings, "mover video", arguments)
    video_to_room(args, config=config)


def video_to_room(
    args: VideoArgs, finders: "Finders | None" = None, config: PerceiveConfig | None = None
) -> None:
    """All steps; what cannot work is said before the first; `finders` stand for the networks.

    Raises:
        InputError: If something is missing, or there is no furniture.
    """
    source, config = args.source, config or PerceiveConfig()
    if not source.is_file() and not source.is_dir():
        raise InputError(f"{source}: {not_there(source)}, expected a video or a folder")
    if source.suffix.lower() in (".json", ".npz", ".pkl", ".txt"):
        raise InputError(f"{source}: is no video, expected one, or a folder of its pictures")
    flags.preset_named(args.preset, PRESETS)
    chain.check_bodies(args.bodies, args.bodies_tool)
    _check_source(source)
    if finders is None:
        _check_needs(args, config)  # in the first second: nothing heavy is loaded yet
    from mover.perceive.video import pictures_of, read_picture

    pictures = pictures_of(source)
    if len(pictures) == 1:
        read_picture(pictures[0])
        say(ONE_IMAGE)
    capture, steps = args.out / "capture", chain.steps_in(args.out, say, STEPS)
    made = _taken(args, config, capture, steps, finders)
    if not pictures and len([*(capture / "frames").iterdir()]) == 1:
        say(ONE_IMAGE)
    if not json.loads(made.read_text())["annotations"]:
        raise InputError(
            f"{capture / 'reference.png'}: the network finds no furniture in it, so there is "
            "nothing to place; --score 0.3 keeps weaker detections"
        )
    if not json.loads((capture / "people.json").read_text())["annotations"]:
        say("warning: no person is seen in the video: only the image places the furniture")
    _bodies(capture, args, steps)
    _first_scene(capture, args, steps)
    _room(capture, args)


def _taken(
    args: VideoArgs, config: PerceiveConfig, capture: Path, steps: chain.Steps,
    finders: "Finders | None",
) -> Path:  # fmt: skip
    """All of the capture but bodies and the first scene, and what stays of it; its last file."""
    own = args.keypoints not in (NETWORK, MEDIAPIPE) and chain.OUT not in args.keypoints
    joints = Path(args.keypoints) if own else args.keypoints.replace(NETWORK, "")
    flags: dict[Path, tuple[object, ...]] = {
        capture / "objects.json": (args.objects, args.objects_frame),
        capture / "people.json": (args.people_masks,),
        capture / "keypoints.npz": (joints,),
        capture / "camera.json": (args.camera, args.fov, args.tilt, args.camera_height),
    }
    stamp, made = _stamp(args.source), capture / "objects.json"
    made_from = [stamp, repr(config), *(chain.digest_of(given) for given in flags.values())]

    def work() -> None:
        keep = [f.name for f in flags if steps.stays(STEPS[0], f, flags[f], stamp)]
        with steps.writing(*flags):
            _pictures(args, config, capture, finders, keep)

    removed = [file for file in flags if steps.changed(file) and not file.exists()]
    steps.do(STEPS[0], made_from, (removed or [made])[0], work, of=stamp)
    return made


def _stamp(source: Path, capture: Path | None = None) -> str:
    """Which video it is; with a capture, under which lens."""
    from mover.perceive.video import stamp_of

    lens = () if capture is None else (lens_in(capture),)
    return str((str(source.resolve()), *stamp_of(source), *lens))


def _pictures(
    args: VideoArgs, config: PerceiveConfig, capture: Path, finders: "Finders | None",
    keep: Sequence[str],
) -> None:  # fmt: skip
    """All of the capture but bodies, the first scene and what the user replaced."""
    import torch

    from mover.app.cli import Bar
    from mover.core.run import Run
    from mover.perceive.capture import Finders, perceive

    torch.set_num_threads(THREADS)
    video = replace(_video(args, capture), keep=tuple(keep))
    with Bar() as bar:
        run = Run(capture / "perceived", bar)
        perceive(video, capture, config, run, say, finders or Finders())
    names = ("frames/", "reference.png", "objects.json", "people.json", "camera.json")
    say(f"{capture}: wrote {', '.join(name for name in names if name not in keep)}")


def _check_source(source: Path) -> None:
    """Refuse what is no video at a glance, before what is missing for one.

    Raises:
        InputError: If it is an empty file or a text, or a folder without pictures.
    """
    if source.is_dir():
        if not any(path.suffix.lower() in PICTURES for path in source.iterdir()):
            raise InputError(f"{source}: has no pictures, expected {', '.join(PICTURES[:3])} ...")
    elif source.is_file():
        with source.open("rb") as file:
            head = file.read(64)
        if head.isascii() and b"\0" not in head:  # nothing at all is ASCII, too
            kind = "a picture" if source.suffix.lower() in PICTURES else "a video, or its pictures"
            raise unreadable(source, "it is a text", kind)


def _check_needs(args: VideoArgs, config: PerceiveConfig) -> None:
    """Refuse to begin where what is still needed is missing; furniture may be outlined later.

    Raises:
        InputError: With a line for each thing that is missing, and what to do about it.
    """
    for path in (args.people_masks, args.objects):
        if path is not None and not path.is_file() and not path.is_dir():
            raise InputError(f"{path}: {not_there(path)}, expected masks or outlines")
    own = args.keypoints not in (NETWORK, MEDIAPIPE)
    if own and chain.OUT not in args.keypoints and not Path(args.keypoints).exists():
        raise InputError(
            f"--keypoints: {args.keypoints!r} is neither network nor mediapipe, nor a file or "
            "folder that is there, nor a command with {out} in it"
        )
    masks = args.people_masks is None and args.keypoints != MEDIAPIPE
    kinds = [*(["masks"] if masks else []), *(["keypoints"] if args.keypoints == NETWORK else [])]
    lacking = missing(config.models, kinds, mediapipe=args.keypoints == MEDIAPIPE)
    if lacking:
        raise InputError("\n  ".join(["not on this machine:", *lacking]))


def _video(args: VideoArgs, capture: Path) -> "Video":
    """The video, and what the user hands in."""
    from mover.perceive.own import Video

    def joints() -> Path:
        if chain.OUT not in args.keypoints:
            return Path(args.keypoints)
        out = capture / "joints-by-command"
        places = {"video": args.source, "frames": capture / "frames", "out": out}
        chain.run_command_line("--keypoints", args.keypoints, places)
        return out

    given = None if args.keypoints in (NETWORK, MEDIAPIPE) else joints
    return Video(
        args.source, args.camera, args.fov, args.tilt, args.camera_height, given,
        "{frames}" in args.keypoints, args.keypoints == MEDIAPIPE, args.people_masks, args.objects,
        args.objects_frame,
    )  # fmt: skip


def _bodies(capture: Path, args: VideoArgs, steps: chain.Steps) -> None:
    """bodies.npz, where people are seen."""
    keypoints, made = capture / "keypoints.npz", capture / "bodies.npz"
    if args.bodies == chain.FIT and not keypoints.is_file():
        say("warning: no keypoints were found, so there are no bodies")
        steps.undo(STEPS[1], made)
        return
    with steps.writing(capture / "people.json"):
        chain.write_heights(capture, args.height)
    given = [] if args.bodies == chain.FIT or chain.OUT in args.bodies else [Path(args.bodies)]
    made_from = [keypoints, lens_in(capture), args.bodies, args.bodies_tool, *given]
    made_from += map(str, args.height)

    def work() -> None:
        if args.bodies == chain.FIT:
            camera = capture / "camera.json"
            fit_into(FitArgs(keypoints, camera, out=made, drop=True, height=args.height))
        else:
            chain.import_bodies(args.bodies, args.bodies_tool, args.source, capture)

    of = _stamp(args.source, capture)
    steps.do(STEPS[1], made_from, made, work, yours=args.bodies == chain.FIT, of=of)


def _first_scene(capture: Path, args: VideoArgs, steps: chain.Steps) -> None:
    """scene.json, under the camera that the bodies constrain."""
    from mover.io.files.images import find_depth_file

    names = ("objects.json", "people.json", "bodies.npz")
    made_from = [*(capture / name for name in names), lens_in(capture)]
    own = find_depth_file(capture) if args.depth is None else (args.depth, True)
    made_from += [str(args.meshes), str((args.tilt, args.camera_height))]
    made_from += [] if own is None else [own[0]]
    asked = LayoutArgs(capture, args.depth, args.meshes)

    def work() -> None:
        with steps.writing(capture / "camera.json"):
            layout_into(asked, LayoutConfig())

    of = _stamp(args.source, capture)
    steps.do(STEPS[2], made_from, capture / "scene.json", work, yours=True, of=of)


def lens_in(capture: Path) -> str:
    """What camera.json says of the lens: the tilt beside it is found with the first scene."""
    from mover.io.capture.camera_file import camera_of
    from mover.io.files.cameras import read_camera_file

    camera = camera_of(read_camera_file(capture / "camera.json", None))
    return f"{camera.width} {camera.height} " + " ".join(f"{v:.6g}" for v in camera.K.flatten())


def _room(capture: Path, args: VideoArgs) -> None:
    """The room and its report; its own stages are kept by themselves."""
    from mover.app.results import Origin
    from mover.core.devices import device_of
    from mover.io.formats import read

    say(f"{len(STEPS)}/{len(STEPS)} {STEPS[-1]} ...")
    people = (capture / "bodies.npz").is_file()
    origin = Origin(str(capture.resolve()), refine=people, device=device_of(args.device))
    preset = flags.preset_named(args.preset, PRESETS)
    reconstruct_into(args.out / "room", read("folder", capture), preset, origin)
    say(f"report: {args.out / 'room' / 'report.html'}")
