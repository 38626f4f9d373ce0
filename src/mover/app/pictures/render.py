"""Draw a result without a screen: over the video, from above or from around, as PNG or MP4."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.board import Tiles, set_up, show, with_base
from mover.app.pictures.config import RenderConfig
from mover.app.pictures.eye import RenderCamera, above_eye, spinning_eyes, video_eye
from mover.app.pictures.film import (
    FILM,
    STILL,
    captioned,
    has_video,
    save_film,
    save_still,
    sized,
    video_library,
    video_pictures,
)
from mover.app.pictures.floor import Ground, ground_under
from mover.app.pictures.paint import Surfaces, furniture, people
from mover.core.errors import InputError
from mover.core.types import Bodies, Scene
from mover.geometry.placement import place_object
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read

FPS = 5.0  # of images that have no time
TURN_RATE, TURN_SECONDS = 24.0, 8.0  # pictures a second and length of a turn without people
WATCHED = 40  # every so many vertices of people count for what an eye should see
ASPECT = 16 / 9  # of pictures that are not the video's


@dataclass(frozen=True)
class World:
    """One of the scenes with its people and its floor."""

    caption: str
    scene: Scene
    bodies: Bodies | None
    still: Surfaces
    ground: Ground
    points: Float[Tensor, "points 3"]
    """What an eye should see [m]."""


@dataclass(frozen=True)
class Moment:
    """One picture of a film."""

    frame: int
    share: float
    """Of the film that is over, in [0, 1)."""


def render_result(out: Path, path: Path, config: RenderConfig, capture: Path | None = None) -> int:
    """Draw a result into a file; the number of pictures.

    Args:
        out: Folder of the result.
        path: .png, .jpg or .mp4.
        config: What is drawn.
        capture: Folder of the capture, whose video (or reference image) is behind the furniture.

    Raises:
        InputError: If something is missing or the ending of `path` is none of these.
    """
    ending = path.suffix.lower()
    if ending not in STILL + FILM:
        raise InputError(f"--to: {path.name!r} ends in {ending!r}, expected .png, .jpg or .mp4")
    if ending in FILM:
        video_library(f"--to {path.name}")
    worlds = [_world(out, name, config) for name in _names(config)]
    moments = _moments(worlds, config, still=ending in STILL)
    pictures = render_worlds(worlds, moments, config, capture)
    if ending in STILL:
        save_still(next(pictures), path)
        return 1
    return save_film(pictures, _rate(worlds, moments), path)


def render_worlds(
    worlds: list[World], moments: list[Moment], config: RenderConfig, capture: Path | None
) -> Iterator[Float[Tensor, "h w 3"]]:
    """One picture after the other, worlds side by side."""
    panels = [_panels(world, worlds, moments, config, capture) for world in worlds]
    for row in zip(*panels, strict=True):
        named = [captioned(p, w.caption) for p, w in zip(row, worlds, strict=True)]
        yield torch.cat(named if len(row) > 1 else list(row), 1)


def _names(config: RenderConfig) -> tuple[str, ...]:
    return ("initial", "result") if config.scene == "both" else (config.scene,)


def _world(out: Path, name: str, config: RenderConfig) -> World:
    """Read one of the scenes of a result."""
    initial = name == "initial"
    scene = read_scene(out / ("initial.json" if initial else "scene.json"))
    file = out / ("initial_bodies.npz" if initial else "bodies.npz")
    bodies = read_bodies(file) if config.people and file.is_file() else None
    return world_of("before" if initial else "after", scene, bodies)


def world_of(caption: str, scene: Scene, bodies: Bodies | None) -> World:
    """A scene and the people in its world, ready to be drawn.

    Raises:
        InputError: If there is neither furniture nor anybody.
    """
    parts = [place_object(piece).verts for piece in scene.objects]
    if bodies is not None:
        parts.append(bodies.verts[:, ::WATCHED].reshape(-1, 3))
    if not parts:
        raise InputError("scene.json: the room is empty: there is nothing to draw")
    points = torch.cat(parts).detach().float()
    height = float(points[:, 1].min()) if scene.ground is None else scene.ground
    ground = ground_under(points, height)
    return World(caption, scene, bodies, furniture(scene), ground, points)


def _moments(worlds: list[World], config: RenderConfig, still: bool) -> list[Moment]:
    frames = sorted({f for w in worlds if w.bodies is not None for f in w.bodies.frame.tolist()})
    if still:
        middle = frames[len(frames) // 2] if frames else 0
        return [Moment(middle if config.frame is None else config.frame, 0.0)]
    if not frames and (config.view != "orbit" or config.turns == 0):
        raise InputError("--to: nothing moves: ask for a .png, or for --view orbit --turns 1")
    count = len(frames) or round(TURN_RATE * TURN_SECONDS)
    return [Moment(f, k / count) for k, f in enumerate(frames or [0] * count)]


def _rate(worlds: list[World], moments: list[Moment]) -> float:
    """Pictures a second."""
    fps = [w.bodies.fps or FPS for w in worlds if w.bodies is not None]
    if not fps or len(moments) < 2:
        return fps[0] if fps else TURN_RATE
    steps = torch.tensor([m.frame for m in moments]).diff().float()
    return fps[0] / max(1.0, float(steps.median()))


def _panels(
    world: World,
    worlds: list[World],
    moments: list[Moment],
    config: RenderConfig,
    capture: Path | None,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """The pictures of one world."""
    rows = _rows_at(world.bodies)
    eyes = _eyes(world, worlds, moments, config)
    over_video = capture is not None and config.view == "camera"
    backs = _backs(capture, moments, eyes[0]) if over_video and capture is not None else None
    board: Tiles | None = None
    for moment, eye in zip(moments, eyes, strict=True):
        base = None if backs is None else next(backs)
        if board is None or board.eye is not eye:
            board = set_up(eye, world.ground, world.still, base)
        elif base is not None:
            board = with_base(board, base)
        present = rows.get(moment.frame, [])
        moving = people(world.bodies, present) if world.bodies is not None and present else None
        yield show(board, moving)


def _rows_at(bodies: Bodies | None) -> dict[int, list[int]]:
    """Rows of the bodies in each frame."""
    found: dict[int, list[int]] = {}
    for row, frame in enumerate([] if bodies is None else bodies.frame.tolist()):
        found.setdefault(frame, []).append(row)
    return found


def _eyes(
    world: World, worlds: list[World], moments: list[Moment], config: RenderConfig
) -> list[RenderCamera]:
    """The eye of each moment: one and the same where it stands still."""
    if config.view == "camera":
        return [video_eye(world.scene.camera, config.width)] * len(moments)
    points = torch.cat([w.points for w in worlds])
    width = config.width - config.width % 2
    size = (width, 2 * round(width / ASPECT / 2))
    if config.view == "above":
        return [above_eye(points, size)] * len(moments)
    start, elevation = math.radians(config.azimuth), math.radians(config.elevation)
    if config.turns == 0:
        return spinning_eyes(points, size, [start], elevation) * len(moments)
    azimuths = [start + 2 * math.pi * config.turns * m.share for m in moments]
    return spinning_eyes(points, size, azimuths, elevation)


def _backs(
    capture: Path, moments: list[Moment], eye: RenderCamera
) -> Iterator[Float[Tensor, "h w 3"]]:
    """The picture behind each moment: of the video, or the reference image."""
    size = (eye.width, eye.height)
    reference = _reference(capture, size)
    frames = [m.frame for m in moments]
    found = video_pictures(capture, frames, size) if has_video(capture) else [None] * len(frames)
    for picture in found:
        yield reference if picture is None else picture


def _reference(capture: Path, size: tuple[int, int]) -> Float[Tensor, "h w 3"]:
    from PIL import Image

    from mover.app.pictures.film import pixels

    image = read("folder", capture).reference
    if image is None:
        return torch.full((size[1], size[0], 3), 0.9)
    return sized(Image.fromarray(pixels(image)), size)
