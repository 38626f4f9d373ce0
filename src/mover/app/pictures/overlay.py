"""A room over its images: furniture tinted, shaded, outlined and named; stills and films of it."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from mover.app.pictures import FILM, STILL, RenderConfig, check_ending
from mover.app.pictures.film import (
    pixels,
    save_film,
    save_still,
    sized,
    video_library,
    video_pictures,
)
from mover.app.pictures.paint import FINE, draw_picture, furniture, joined, people
from mover.bodies.corrected import in_world
from mover.core.colours import colour, css
from mover.core.errors import InputError
from mover.core.records import map_tensors, rows_of
from mover.core.types import Bodies, Capture, Masks, Scene
from mover.geometry.placement import placed_at
from mover.geometry.rle import decode
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read

SOME_BODIES = 5  # in the picture of a check
WHITE = (1.0, 1.0, 1.0)
WIDEST = 1280  # [px], of a picture in the report


def draw_overlay(image: Float[Tensor, "h w 3"], scene: Scene) -> Float[Tensor, "height width 3"]:
    """Draw the furniture of `scene` over a picture in [0, 1] of the whole view of its camera."""
    surfaces = furniture(scene)
    if not len(surfaces.faces):
        return image
    picture, owner = draw_picture(surfaces, scene.camera, image, scene.ground)
    return _named(picture, owner[::FINE, ::FINE], scene)


def save_overlay(capture: Capture, path: Path) -> Path:
    """Draw what was given over the reference image into the file `path` (.png, .jpg, ...).

    The initial scene, some of the bodies, and the boxes and masks that all of it should lie on.
    """
    capture = map_tensors(on_cpu, capture)
    scene, bodies = capture.scene, capture.bodies
    frames, picture = list[int](), canvas(capture.reference, scene)
    if bodies is not None:
        count = len(bodies.frame)
        rows = torch.linspace(0, count - 1, min(count, SOME_BODIES)).long()
        frames, some = bodies.frame[rows].tolist(), in_world(rows_of(bodies, rows), scene.camera)
        picture, _ = draw_picture(people(some, list(range(len(rows)))), scene.camera, picture)
    picture = draw_overlay(picture, scene)
    save_still(_given(picture, capture, frames), path)
    return path


def _given(
    picture: Float[Tensor, "h w 3"], capture: Capture, frames: Sequence[int]
) -> Float[Tensor, "h w 3"]:
    """Boxes and masks of the furniture in the objects' colours, people's in some frames white."""
    from scipy.ndimage import binary_erosion

    page, size = Image.fromarray(pixels(picture)), (picture.shape[1], picture.shape[0])
    pen, camera = ImageDraw.Draw(page), capture.scene.camera
    zoom = torch.tensor([size[0] / camera.width, size[1] / camera.height] * 2)
    order = [one.annotation for one in capture.scene.objects]
    masks: list[tuple[Masks, int, tuple[float, float, float]]] = []
    for seen in capture.detections:
        tint = colour(order.index(seen.id)) if seen.id in order else WHITE
        pen.rectangle((seen.box * zoom).tolist(), outline=css(tint), width=2)
        masks += [] if seen.mask is None else [(seen.mask, 0, tint)]
    if capture.people is not None:
        shown = torch.isin(capture.people.frame, torch.tensor(frames, dtype=torch.long))
        masks += [(capture.people.masks, row, WHITE) for row in shown.nonzero()[:, 0].tolist()]
    found = np.asarray(page).copy()
    for mask, row, tint in masks:
        shape = Image.fromarray(decode(mask, row).numpy()).resize(size)
        inside = np.asarray(shape, dtype=np.bool_)
        found[inside & ~binary_erosion(inside, iterations=2)] = [round(255 * c) for c in tint]
    return torch.from_numpy(found).float() / 255


def on_cpu(tensor: Tensor) -> Tensor:
    """On the CPU, in single precision, without a history."""
    there = tensor.detach().cpu()
    return there.float() if there.is_floating_point() else there


def canvas(image: Float[Tensor, "h w 3"] | None, scene: Scene) -> Float[Tensor, "height width 3"]:
    """What the furniture is drawn on, at most `WIDEST` pixels wide: the image or a backdrop."""
    if image is None:
        width = min(WIDEST, scene.camera.width)
        return backdrop(max(1, round(width * scene.camera.height / scene.camera.width)), width)
    if image.shape[1] <= WIDEST:
        return image.detach().cpu().float()
    size = (WIDEST, max(1, round(WIDEST * image.shape[0] / image.shape[1])))
    return sized(Image.fromarray(pixels(image)), size)


def backdrop(height: int, width: int) -> Float[Tensor, "height width 3"]:
    """A neutral picture, a little lighter above."""
    fade = torch.linspace(0.93, 0.80, height)[:, None, None]
    return fade.expand(height, width, 3) * torch.tensor([0.985, 0.99, 1.0])


def _named(
    picture: Float[Tensor, "h w 3"], owner: Int[Tensor, "h w"], scene: Scene
) -> Float[Tensor, "h w 3"]:
    """Write each visible object's id over its middle, moved down until it covers no other."""
    page = Image.fromarray(pixels(picture))
    pen = ImageDraw.Draw(page)
    size = max(10.0, picture.shape[1] / 80)
    font = ImageFont.load_default(size)
    taken: list[tuple[float, float, float, float]] = []
    for index, item in enumerate(scene.objects):
        visible = (owner == index).nonzero()
        if len(visible) < size * size:
            continue
        y, x = visible.double().mean(0).tolist()
        wide, high = pen.textlength(item.id, font) / 2 + 0.55 * size, 0.75 * size
        box = (x - wide, y - high, x + wide, y + high)
        while any(
            box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken
        ):
            y += 0.5 * size
            box = (x - wide, y - high, x + wide, y + high)
        taken.append(box)
        red, green, blue = (0.72 * c for c in colour(index))
        pen.rounded_rectangle(box, size * 0.45, fill=css((red, green, blue)))
        pen.text((x, y), item.id, fill="white", font=font, anchor="mm")
    return torch.from_numpy(np.asarray(page).copy()).float() / 255


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
        save_still(next(render_room(scene, shown, [frame], config.width, capture)), path)
        return 1
    video_library(f"--to {path.name}")
    if bodies is None or not frames:
        raise InputError("--to: nothing moves: ask for a .png")
    steps = torch.tensor(frames).diff().float()
    rate = (bodies.fps or FPS) / (max(1.0, float(steps.median())) if len(steps) else 1.0)
    return save_film(render_room(scene, shown, frames, config.width, capture), rate, path)


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
        image, found = read("folder", capture).reference, video_pictures(capture, frames, size)
        base = base if image is None else sized(Image.fromarray(pixels(image)), size)
    for frame, picture in zip(frames, found, strict=True):
        stands = tuple(placed_at(item, frame) for item in scene.objects)
        surfaces = [furniture(dataclasses.replace(scene, objects=stands))]
        if bodies is not None:
            surfaces.append(people(bodies, (bodies.frame == frame).nonzero()[:, 0].tolist()))
        behind = base if picture is None else picture
        yield draw_picture(joined(surfaces), camera, behind, scene.ground)[0]
