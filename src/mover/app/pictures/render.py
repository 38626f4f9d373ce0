"""Draw a result without a screen: over the video, from above or from around, as PNG or MP4."""

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.config import FILM, STILL, RenderConfig, check_ending
from mover.app.pictures.eye import (
    RenderCamera,
    above_eye,
    part_of,
    seen_from,
    spinning_eyes,
    video_eye,
)
from mover.app.pictures.film import (
    captioned,
    has_video,
    save_film,
    save_still,
    sized,
    video_library,
    video_pictures,
)
from mover.app.pictures.paint import (
    FINE,
    Drawn,
    GroundPatch,
    Ink,
    Surfaces,
    backdrop,
    cut,
    draw,
    fine_eye,
    furniture,
    ground_under,
    metre_lines,
    nearer,
    over,
    paint,
    people,
    shadows,
)
from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Bodies, Scene
from mover.geometry.placement import place_object, placed_at
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
    ground: GroundPatch
    points: Float[Tensor, "points 3"]
    """What an eye should see [m]."""


@dataclass(frozen=True)
class Shot:
    """One picture of a film."""

    frame: int
    share: float
    """Of the film that is over, in [0, 1)."""


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
    names = ("initial", "result") if config.scene == "both" else (config.scene,)
    worlds = [_world(out, name, config) for name in names]
    moments = _moments(worlds, config, still)
    pictures = render_worlds(worlds, moments, config, capture)
    if still:
        save_still(next(pictures), path)
        return 1
    return save_film(pictures, _rate(worlds, moments), path)


def render_worlds(
    worlds: list[World], moments: list[Shot], config: RenderConfig, capture: Path | None
) -> Iterator[Float[Tensor, "h w 3"]]:
    """One picture after the other, worlds side by side."""
    panels = [_panels(world, worlds, moments, config, capture) for world in worlds]
    for row in zip(*panels, strict=True):
        named = [captioned(p, w.caption) for p, w in zip(row, worlds, strict=True)]
        yield torch.cat(named if len(row) > 1 else list(row), 1)


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
        InputError: If there are neither objects nor people.
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


def _moments(worlds: list[World], config: RenderConfig, still: bool) -> list[Shot]:
    frames = sorted({f for w in worlds if w.bodies is not None for f in w.bodies.frame.tolist()})
    if still:
        middle = frames[len(frames) // 2] if frames else 0
        return [Shot(middle if config.frame is None else config.frame, 0.0)]
    if not frames and (config.view != "orbit" or config.turns == 0):
        raise InputError("--to: nothing moves: ask for a .png, or for --view orbit --turns 1")
    count = len(frames) or round(TURN_RATE * TURN_SECONDS)
    return [Shot(f, k / count) for k, f in enumerate(frames or [0] * count)]


def _rate(worlds: list[World], moments: list[Shot]) -> float:
    """Pictures a second."""
    fps = [w.bodies.fps or FPS for w in worlds if w.bodies is not None]
    if not fps or len(moments) < 2:
        return fps[0] if fps else TURN_RATE
    steps = torch.tensor([m.frame for m in moments]).diff().float()
    return fps[0] / max(1.0, float(steps.median()))


def _panels(
    world: World,
    worlds: list[World],
    moments: list[Shot],
    config: RenderConfig,
    capture: Path | None,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """The pictures of one world."""
    rows = _rows_at(world.bodies)
    eyes = _eyes(world, worlds, moments, config)
    over_video = capture is not None and config.view == "camera"
    backs = _backs(capture, moments, eyes[0]) if over_video and capture is not None else None
    changes = sorted({s.frame for piece in world.scene.objects for s in piece.segments})
    board, still, time = None, world.still, -1
    for moment, eye in zip(moments, eyes, strict=True):
        base, before = None if backs is None else next(backs), time
        time = bisect_right(changes, moment.frame)
        if time != before and changes:
            still = furniture(_scene_at(world.scene, moment.frame))
        if board is None or board.eye is not eye or time != before:
            board = set_up(eye, world.ground, still, base)
        elif base is not None:
            board = dataclasses.replace(board, base=base)  # type: ignore[type-var]
        present = rows.get(moment.frame, [])
        moving = people(world.bodies, present) if world.bodies is not None and present else None
        yield show(board, moving)


def _scene_at(scene: Scene, frame: int) -> Scene:
    """The furniture where it stands in a frame."""
    pieces = tuple(placed_at(piece, frame) for piece in scene.objects)
    return dataclasses.replace(scene, objects=pieces)


def _rows_at(bodies: Bodies | None) -> dict[int, list[int]]:
    """Rows of the bodies in each frame."""
    found: dict[int, list[int]] = {}
    for row, frame in enumerate([] if bodies is None else bodies.frame.tolist()):
        found.setdefault(frame, []).append(row)
    return found


def _eyes(
    world: World, worlds: list[World], moments: list[Shot], config: RenderConfig
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
    capture: Path, moments: list[Shot], eye: RenderCamera
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


OPACITY = 0.72  # of surfaces over a picture
THICK = 800  # [px] of width for each coarse pixel of an outline's thickness
RIM = 3  # [px] around a window that are drawn but not used: lines need neighbours
NEAR = 0.1  # [m], people nearer to the eye than this fill the whole picture
SHADE = 0.5  # [m], how far the shadow of people reaches


@record
class Tiles:
    """What does not move, drawn once."""

    eye: RenderCamera
    ground: GroundPatch
    ink: Ink
    still: Drawn
    """The furniture in fine pixels."""
    floor: Float[Tensor, "h w 4"]
    """Shadows of the furniture and metre lines."""
    sheet: Float[Tensor, "h w 4"]
    """The furniture."""
    base: Float[Tensor, "h w 3"]
    """What is behind."""


def set_up(
    eye: RenderCamera,
    ground: GroundPatch,
    still: Surfaces,
    base: Float[Tensor, "h w 3"] | None = None,
) -> Tiles:
    """Draw the furniture.

    Args:
        eye: From where.
        ground: The floor.
        still: The furniture.
        base: A picture of the size of the eye's; None: a plain room.
    """
    over_picture = base is not None
    ink = Ink(OPACITY if over_picture else 1.0, max(1, round(eye.width / THICK)))
    drawn = draw(still, fine_eye(eye))
    lines = metre_lines(eye, ground, 1.0 if over_picture else 0.58)
    floor = lines if over_picture else over(shadows(eye, ground, still), lines)
    picture = base if base is not None else backdrop(eye, ground)
    return Tiles(eye, ground, ink, drawn, floor, paint(drawn, ink), picture)


def show(board: Tiles, moving: Surfaces | None = None) -> Float[Tensor, "h w 3"]:
    """The picture, with people in it."""
    picture = over(board.sheet, over(board.floor, board.base))
    if moving is None or not len(moving.faces):
        return picture.clamp(0, 1)
    window = _window(board, moving)
    left, top, right, bottom = window
    if right <= left or bottom <= top:
        return picture.clamp(0, 1)
    patch = _patch(board, moving, window)
    rim = [RIM if edge else 0 for edge in (left, top)]
    end = [
        RIM if e < size else 0 for e, size in ((right, board.eye.width), (bottom, board.eye.height))
    ]
    inner = patch[rim[1] : bottom - top - end[1], rim[0] : right - left - end[0]]
    picture[top + rim[1] : bottom - end[1], left + rim[0] : right - end[0]] = inner
    return picture.clamp(0, 1)


def _patch(
    board: Tiles, moving: Surfaces, window: tuple[int, int, int, int]
) -> Float[Tensor, "height width 3"]:
    """The window with people in it."""
    left, top, right, bottom = window
    here = (slice(top, bottom), slice(left, right))
    fine = [FINE * edge for edge in window]
    moved = draw(moving, part_of(fine_eye(board.eye), *fine))
    drawn = nearer(cut(board.still, *fine), moved)
    behind = over(board.floor[here], board.base[here])
    if board.ink.opacity == 1:
        behind = over(shadows(part_of(board.eye, *window), board.ground, moving), behind)
    return over(paint(drawn, board.ink), behind)


def _window(board: Tiles, moving: Surfaces) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what people and their shadows fill [px]."""
    eye = board.eye
    flat = moving.verts.clone()
    flat[:, 1] = board.ground.height
    around = torch.tensor([[SHADE, 0, SHADE], [-SHADE, 0, SHADE], [SHADE, 0, -SHADE]])
    around = torch.cat([around, -around[:1]])
    corners = (flat[:, None] + around).reshape(-1, 3)
    points = seen_from(eye, torch.cat([moving.verts, corners]))
    whole = (0, 0, eye.width, eye.height)
    if float(seen_from(eye, moving.verts)[:, 2].min()) < NEAR:
        return whole
    points = points[points[:, 2] > NEAR]
    pixel = (points @ eye.K.mT)[:, :2] / points[:, 2:]
    size = torch.tensor([eye.width, eye.height])
    low = (pixel.amin(0).floor() - RIM).long().clamp_min(0).minimum(size)
    high = (pixel.amax(0).ceil() + RIM).long().clamp_min(0).minimum(size)
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    return left, top, right, bottom
