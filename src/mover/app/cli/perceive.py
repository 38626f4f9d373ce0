"""What `perceive` and `layout` do."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mover.app.cli.config import parsed
from mover.app.cli.console import say
from mover.core.errors import InputError
from mover.core.settings import float_in
from mover.perceive.config import LayoutConfig, Lens, ModelsConfig, PerceiveConfig
from mover.perceive.networks import check_networks, in_folder

THREADS = 1  # of torch, as in `run`


@dataclass(frozen=True)
class LayoutArgs:
    """Find a first scene: furniture of the library (or yours) where the picture shows some.

    Needs camera.json and objects.json in the capture, and is far better with bodies.npz, whose feet
    tell where the floor is; writes scene.json, meshes/ and hypotheses.json.
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE")]
    """The capture folder."""
    depth: Path | None = None
    """Metric depth of the reference picture (.npz, .npy [m], 16-bit .png [mm]): a copy goes into
    the capture, for `mover run`, too."""
    meshes: Path | None = None
    """Folder with your own shapes, named after their class: chair_0.obj."""
    config: Annotated[LayoutConfig, arg(name="")] = field(default_factory=LayoutConfig)


@dataclass(frozen=True)
class PerceiveArgs:
    """From a video to a capture: frames, masks, joints, a clean picture and a first scene.

    A run that was killed goes on where it stopped. Bodies in 3D are still missing afterwards.
    """

    source: Annotated[Positional[Path], arg(metavar="VIDEO")]
    """A video, or a folder of pictures."""
    out: Path
    """The capture folder."""
    camera: Path | None = None
    """A calibration; GeoCalib's also tells pitch and roll."""
    fov: Annotated[float, float_in(1, 179)] | None = None
    """Horizontal field of view, where there is no calibration [degrees]."""
    photo: Path | None = None
    """A photo of the same camera, whose EXIF tells the focal length."""
    depth: Path | None = None
    """Metric depth of the reference picture, for the first scene and `mover run`."""
    meshes: Path | None = None
    """Folder with your own shapes, for the first scene."""
    layout: bool = True
    """Find the first scene, too."""
    weights: Path | None = None
    """Folder with the networks, for a machine without a network: one folder for each."""
    config: Annotated[PerceiveConfig, arg(name="")] = field(default_factory=PerceiveConfig)


def perceive(arguments: Sequence[str]) -> None:
    """`mover perceive`."""
    args = parsed(PerceiveArgs, "mover perceive", arguments)
    perceive_into(args, ready_models(args.config.models, args.weights))
    if args.layout:
        layout_into(LayoutArgs(args.out, args.depth, args.meshes))
    say("still missing: bodies.npz (mover fit, or mover import-bodies TOOL PATH)")
    say(f"next: mover check {args.out}; mover run {args.out} --out OUT")


def layout(arguments: Sequence[str]) -> None:
    """`mover layout`."""
    args = parsed(LayoutArgs, "mover layout", arguments)
    layout_into(args)
    say(f"next: mover check {args.capture}; mover run {args.capture} --out OUT")


def ready_models(models: ModelsConfig, weights: Path | None) -> ModelsConfig:
    """The networks, from the folder where one is given; all that is missing is said at once.

    Raises:
        InputError: If something is missing.
    """
    models = models if weights is None else in_folder(models, weights)
    check_networks(models)
    return models


def perceive_into(
    args: PerceiveArgs,
    models: ModelsConfig,
    finders: Any = None,  # noqa: ANN401
) -> None:
    """Fill the capture with all but the first scene.

    Args:
        args: What is asked.
        models: The networks.
        finders: What stands for them, `perceive.capture.Finders`; None: they themselves.
    """
    import torch

    from mover.app.cli.progress import Bar
    from mover.core.run import Run
    from mover.perceive.capture import NETWORKS, Video
    from mover.perceive.capture import perceive as fill

    torch.set_num_threads(THREADS)
    video = Video(args.source, Lens(args.camera, args.fov, args.photo))
    config = replace(args.config, models=models)
    with Bar() as bar:
        run = Run(args.out / "perceived", bar)
        fill(video, args.out, config, run, say, finders or NETWORKS)
    say(f"{args.out}: wrote frames/, reference.png, objects.json, people.json, camera.json")


def take_depth(depth: Path, capture: Path) -> None:
    """A copy of a measured depth becomes the capture's own, for `mover run`, too.

    Raises:
        InputError: If there is no such file, or the capture has an inverse depth.
    """
    from mover.core.files import copy_whole
    from mover.io.files.depth import DEPTH, find_depth_file

    if not depth.is_file():
        raise InputError(f"{depth}: there is no such file, expected a depth map")
    if not capture.is_dir():
        raise InputError(f"{capture}: there is no such folder, expected a capture")
    place = capture / DEPTH / f"000000{depth.suffix.lower()}"
    if depth.resolve() != place.resolve():
        for old in (capture / DEPTH).glob("000000.*"):
            old.unlink()
        copy_whole(depth, place)
    find_depth_file(capture)


def layout_into(args: LayoutArgs) -> None:
    """Write the first scene into the capture."""
    import torch

    from mover.app.cli.progress import Bar
    from mover.core.run import Run
    from mover.io.capture.bodies_file import read_bodies
    from mover.perceive.capture import read_picture_of, write_first_scene
    from mover.perceive.layout import first_scene
    from mover.perceive.standing import standing_on

    torch.set_num_threads(THREADS)
    if args.depth is not None:
        take_depth(args.depth, args.capture)
    picture, people = read_picture_of(args.capture), args.capture / "bodies.npz"
    with Bar() as bar:
        run = Run(args.capture / "perceived", bar)
        if people.is_file():
            picture = standing_on(picture, read_bodies(people), run)
        first = first_scene(picture, args.config, run, args.meshes)
    write_first_scene(first, args.capture)
    ground = first.scene.ground
    height = "" if ground is None else f", camera {-ground:.2f} m above the floor"
    say(f"{args.capture}: first scene of {len(first.scene.objects)} objects{height}")
    if first.skipped:
        say(f"note: not on the floor, left out: {', '.join(sorted(set(first.skipped)))}")
