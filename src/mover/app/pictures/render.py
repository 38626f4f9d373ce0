"""Draw a result without a screen: over the video, from above or from around, as PNG or MP4."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover.app.pictures.config import FILM, STILL, RenderConfig, check_ending
from mover.app.pictures.eye import RenderCamera, above_eye, spinning_eyes, video_eye
from mover.app.pictures.film import (
    pixels,
    save_film,
    save_still,
    sized,
    video_library,
    video_pictures,
)
from mover.app.pictures.paint import draw_picture, furniture, ground_under, joined, people
from mover.core.errors import InputError
from mover.core.types import Bodies, Scene
from mover.geometry.placement import place_object, placed_at
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read

FPS = 5.0  # of images that have no time
TURN_RATE, TURN_SECONDS = 24.0, 8.0  # pictures a second and length of a turn without people
WATCHED = 40  # every so many vertices of people count for what an eye should see
ASPECT = 16 / 9  # of pictures that are not the video's


def render_result(out: Path, path: Path, config: RenderConfig, capture: Path | None = None) -> int:
    """Draw a result into a file; the number of pictures.

    Args:
        out: Folder of the result.
        path: .png, .jpg, .jpeg or .mp4.
        config: What is drawn.
        capture: Folder of the capture, whose video (or reference image) is behind the furniture.

    Raises:
        InputError: If something is missing or the ending of `path` is none of these.
    """
    check_ending("--to", path, STILL + FILM)
    still = path.suffix.lower() in STILL
    if not still:
        video_library(f"--to {path.name}")
    initial = config.scene == "initial"
    scene = read_scene(out / ("initial.json" if initial else "scene.json"))
    file = out / ("initial_bodies.npz" if initial else "bodies.npz")
    bodies = read_bodies(file) if config.people and file.is_file() else None
    frames, rate = _frames(bodies, config, still)
    pictures = render_room(scene, bodies, frames, config, capture)
    if still:
        save_still(next(pictures), path)
        return 1
    return save_film(pictures, rate, path)


def _frames(
    bodies: Bodies | None, config: RenderConfig, still: bool
) -> tuple[Sequence[int], float]:
    """The frames that are drawn, and pictures a second."""
    frames = [] if bodies is None else bodies.frame.unique().tolist()
    if still:
        middle = frames[len(frames) // 2] if frames else 0
        return [middle if config.frame is None else config.frame], FPS
    if not frames and (config.view != "orbit" or config.turns == 0):
        raise InputError("--to: nothing moves: ask for a .png, or for --view orbit --turns 1")
    if bodies is None or not frames:
        return [0] * round(TURN_RATE * TURN_SECONDS), TURN_RATE
    steps = torch.tensor(frames).diff().float()
    return frames, (bodies.fps or FPS) / (max(1.0, float(steps.median())) if len(steps) else 1.0)


def render_room(
    scene: Scene,
    bodies: Bodies | None,
    frames: Sequence[int],
    config: RenderConfig,
    capture: Path | None = None,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """A room and the people in its world, one picture a frame.

    Raises:
        InputError: If there are neither objects nor people.
    """
    parts = [place_object(item).verts for item in scene.objects]
    if bodies is not None:
        parts.append(bodies.verts[:, ::WATCHED].reshape(-1, 3))
    if not parts:
        raise InputError("scene.json: the room is empty: there is nothing to draw")
    points = torch.cat(parts).detach().float()
    ground = ground_under(
        points, float(points[:, 1].min() if scene.ground is None else scene.ground)
    )
    eyes = _eyes(scene, points, len(frames), config)
    bases: Iterator[Float[Tensor, "h w 3"] | None] = iter([None] * len(frames))
    if capture is not None and config.view == "camera":
        bases = _bases(capture, frames, eyes[0])
    for frame, eye, base in zip(frames, eyes, bases, strict=True):
        stands = tuple(placed_at(item, frame) for item in scene.objects)
        surfaces = [furniture(dataclasses.replace(scene, objects=stands))]
        if bodies is not None:
            surfaces.append(people(bodies, (bodies.frame == frame).nonzero()[:, 0].tolist()))
        yield draw_picture(joined(surfaces), eye, ground, base)[0]


def _eyes(
    scene: Scene, points: Float[Tensor, "points 3"], count: int, config: RenderConfig
) -> list[RenderCamera]:
    """The eye of each picture."""
    if config.view == "camera":
        return [video_eye(scene.camera, config.width)] * count
    width = config.width - config.width % 2
    size = (width, 2 * round(width / ASPECT / 2))
    if config.view == "above":
        return [above_eye(points, size)] * count
    start, elevation = math.radians(config.azimuth), math.radians(config.elevation)
    azimuths = [start + 2 * math.pi * config.turns * k / count for k in range(count)]
    return spinning_eyes(points, size, azimuths, elevation)


def _bases(
    capture: Path, frames: Sequence[int], eye: RenderCamera
) -> Iterator[Float[Tensor, "h w 3"]]:
    """The picture behind each frame: of the video, or the reference image."""
    size, image = (eye.width, eye.height), read("folder", capture).reference
    reference = torch.full((eye.height, eye.width, 3), 0.9)
    if image is not None:
        reference = sized(Image.fromarray(pixels(image)), size)
    for picture in video_pictures(capture, frames, size):
        yield reference if picture is None else picture
