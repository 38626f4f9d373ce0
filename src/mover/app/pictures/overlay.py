"""Furniture over the reference image: tinted, shaded, outlined and named."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mover.app.pictures.eye import RenderCamera, camera_sized
from mover.app.pictures.film import pixels, save_still, sized
from mover.app.pictures.paint import (
    FINE,
    NO_OWNER,
    Ink,
    draw,
    fine_eye,
    furniture,
    ground_under,
    joined,
    metre_lines,
    over,
    paint,
    skin,
)
from mover.core.colours import colour, css
from mover.core.records import map_tensors
from mover.core.types import Capture, Mesh, Scene

WIDEST = 1280  # [px], of a picture in the report
OPACITY = 0.62  # of surfaces
AMBIENT, LAMP, FILL = 0.62, 0.48, 0.12  # brighter than a room by itself; the fill is at the camera
FAINT = 0.6  # of the floor's lines as they are in a room by itself
THICK = 550  # [px] of width for each fine pixel of an outline's thickness


def draw_overlay(
    image: Float[Tensor, "h w 3"] | None, scene: Scene, bodies: Mesh | None = None
) -> Float[Tensor, "height width 3"]:
    """Draw the furniture of `scene` over `image`, which shows the whole view of its camera.

    Args:
        image: The reference image in [0, 1], of any resolution; None: a neutral backdrop.
        scene: The furniture and its camera.
        bodies: People to draw with it, in the scene's world [m].
    """
    if image is None:
        image = _backdrop(scene.camera.height, scene.camera.width)
    height, width = image.shape[:2]
    people = [] if bodies is None else [skin(bodies.verts, bodies.faces, 0)]
    surfaces = joined([furniture(scene), *people])
    if not len(surfaces.faces):
        return image
    eye = camera_sized(scene.camera, width, height)
    drawn = draw(surfaces, fine_eye(eye))
    x, y, z = (-FILL * eye.R_eye_world[2]).tolist()
    ink = Ink(OPACITY, max(1, round(width / THICK)), AMBIENT, LAMP, (x, y, z))
    free = avg_pool2d((drawn.owner == NO_OWNER).float()[None], FINE)[0, ..., None]
    picture = over(paint(drawn, ink), over(_floor(eye, scene) * free, image))
    return _named(picture.clamp(0, 1), drawn.owner[::FINE, ::FINE], scene)


def save_overlay(capture: Capture, path: Path) -> Path:
    """Draw the initial scene over the reference image into the file `path` (.png, .jpg, ...)."""
    scene, image = map_tensors(on_cpu, (capture.scene, capture.reference))
    save_still(draw_overlay(canvas(image, scene, WIDEST), scene), path)
    return path


def on_cpu(tensor: Tensor) -> Tensor:
    """On the CPU, in single precision, without a history."""
    there = tensor.detach().cpu()
    return there.float() if there.is_floating_point() else there


def canvas(
    image: Float[Tensor, "h w 3"] | None, scene: Scene, widest: int
) -> Float[Tensor, "height width 3"]:
    """What the furniture is drawn on, at most `widest` pixels wide: the image or a backdrop."""
    if image is not None:
        return shrink(image, widest)
    width = min(widest, scene.camera.width)
    return _backdrop(max(1, round(width * scene.camera.height / scene.camera.width)), width)


def shrink(image: Float[Tensor, "h w 3"], widest: int) -> Float[Tensor, "height width 3"]:
    """The image at most `widest` pixels wide."""
    if image.shape[1] <= widest:
        return image.detach().cpu().float()
    size = (widest, max(1, round(widest * image.shape[0] / image.shape[1])))
    return sized(Image.fromarray(pixels(image)), size)


def _backdrop(height: int, width: int) -> Float[Tensor, "height width 3"]:
    """A neutral picture, a little lighter above."""
    fade = torch.linspace(0.93, 0.80, height)[:, None, None]
    return fade.expand(height, width, 3) * torch.tensor([0.985, 0.99, 1.0])


def _floor(eye: RenderCamera, scene: Scene) -> Float[Tensor, "h w 4"]:
    """A sheet of faint lines on the floor, one metre apart, around the furniture."""
    if scene.ground is None or not scene.objects or scene.ground >= 0:
        return torch.zeros(eye.height, eye.width, 4)
    ground = ground_under(furniture(scene).verts, scene.ground)
    return FAINT * metre_lines(eye, ground, 1.0)


def _named(
    picture: Float[Tensor, "h w 3"], owner: Int[Tensor, "h w"], scene: Scene
) -> Float[Tensor, "h w 3"]:
    """Write each visible object's id over its middle."""
    page = Image.fromarray(pixels(picture))
    pen = ImageDraw.Draw(page)
    size = max(10.0, picture.shape[1] / 80)
    font = ImageFont.load_default(size)
    taken: list[tuple[float, float, float, float]] = []
    for index, piece in enumerate(scene.objects):
        seen = (owner == index).nonzero()
        if len(seen) < size * size:
            continue
        y, x = seen.double().mean(0).tolist()
        box = _free_place(x, y, pen.textlength(piece.id, font), size, taken)
        taken.append(box)
        pen.rounded_rectangle(box, size * 0.45, fill=css(_deep(colour(index))))
        middle = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        pen.text(middle, piece.id, fill="white", font=font, anchor="mm")
    return torch.from_numpy(np.asarray(page).copy()).float() / 255


def _deep(rgb: tuple[float, float, float]) -> tuple[float, float, float]:
    r, g, b = (0.72 * c for c in rgb)
    return r, g, b


def _free_place(
    x: float, y: float, length: float, size: float, taken: list[tuple[float, float, float, float]]
) -> tuple[float, float, float, float]:
    """Box of a label around (x, y) [px], moved down until it covers no other."""
    half = (length / 2 + 0.55 * size, 0.75 * size)
    box = (x - half[0], y - half[1], x + half[0], y + half[1])
    while any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
        box = (box[0], box[1] + 0.5 * size, box[2], box[3] + 0.5 * size)
    return box
