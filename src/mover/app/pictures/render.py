"""Draw a result without a screen, over the video: a picture as PNG or JPEG, or a film as MP4."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover.app.pictures import film
from mover.app.pictures.config import FILM, STILL, RenderConfig, check_ending
from mover.app.pictures.overlay import backdrop
from mover.app.pictures.paint import draw_picture, furniture, joined, people
from mover.core.errors import InputError
from mover.core.types import Bodies, Scene
from mover.geometry.placement import placed_at
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read

FPS = 5.0  # of images that have no time


def render_result(out: Path, path: Path, config: RenderConfig, capture: Path | None = None) -> int:
    """Draw a result into a .png, .jpg, .jpeg or .mp4; the number of pictures.

    The video of the capture, or its reference image, is behind the furniture.

    Raises:
        InputError: If something is missing or the ending of `path` is none of these.
    """
    check_ending("--to", path, STILL + FILM)
    initial = config.scene == "initial"
    scene = read_scene(out / ("initial.json" if initial else "scene.json"))
    file = out / ("initial_bodies.npz" if initial else "bodies.npz")
    bodies = read_bodies(file) if file.is_file() else None
    frames = [] if bodies is None else bodies.frame.unique().tolist()
    if not scene.objects and not frames:
        raise InputError("scene.json: the room is empty: there is nothing to draw")
    shown = bodies if config.people else None
    if path.suffix.lower() in STILL:
        middle = frames[len(frames) // 2] if frames else 0
        frame = middle if config.frame is None else config.frame
        film.save_still(next(render_room(scene, shown, [frame], config.width, capture)), path)
        return 1
    film.video_library(f"--to {path.name}")
    if bodies is None or not frames:
        raise InputError("--to: nothing moves: ask for a .png")
    steps = torch.tensor(frames).diff().float()
    rate = (bodies.fps or FPS) / (max(1.0, float(steps.median())) if len(steps) else 1.0)
    return film.save_film(render_room(scene, shown, frames, config.width, capture), rate, path)


def render_room(
    scene: Scene,
    bodies: Bodies | None,
    frames: Sequence[int],
    width: int,
    capture: Path | None = None,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """A room and the people in its world, one picture a frame, even in width and height [px]."""
    camera, width = scene.camera, width - width % 2
    size = width, max(2, 2 * round(width * camera.height / camera.width / 2))
    base = backdrop(size[1], size[0])
    found: Iterator[Float[Tensor, "h w 3"] | None] = iter([None] * len(frames))
    if capture is not None:
        image, found = read("folder", capture).reference, film.video_pictures(capture, frames, size)
        base = base if image is None else film.sized(Image.fromarray(film.pixels(image)), size)
    for frame, picture in zip(frames, found, strict=True):
        stands = tuple(placed_at(item, frame) for item in scene.objects)
        surfaces = [furniture(dataclasses.replace(scene, objects=stands))]
        if bodies is not None:
            surfaces.append(people(bodies, (bodies.frame == frame).nonzero()[:, 0].tolist()))
        behind = base if picture is None else picture
        yield draw_picture(joined(surfaces), camera, behind, scene.ground)[0]
