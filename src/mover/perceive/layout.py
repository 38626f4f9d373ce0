"""A first scene from masks, boxes and classes of one picture, without any network.

1. Each detected thing gets a few shapes of its class (candidates.py).
2. Boxes alone tell the camera's height and which shapes and turns are possible (screen.py).
3. Silhouettes decide: the descent of the main job (Eq. 1 with its image terms alone, in the robust
   form) from several turns of several shapes of each thing, all at once.

Everything stands on the ground. What is best becomes the scene; the next best shapes and places of
each thing are kept beside it.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..energy import HumanCues, ImageCues, SceneWeights
from ..furniture.library import canonical
from ..minimize import Adam
from ..records import record
from ..run import Run
from ..stages.find_image_cues import ImageConfig, ImageInputs, find_image_cues
from ..stages.place_objects import PlaceConfig, PlaceInputs, place_objects
from ..stages.prepare_objects import (
    PrepareConfig,
    Prepared,
    PrepareInputs,
    prepare_objects,
    restore,
)
from ..types import Camera, Detection, Layout, Piece, Scene
from .candidates import Shape, is_placed, shapes_of
from .depth_map import floor_height, median_depths, range_in
from .layout_items import best_items, outer_points, piece_of, repeated, starts_of
from .screen import ScreenConfig, ScreenInputs, screen

SLACK = 0.05  # error of measured depth [share]
SHORT = Adam(40, 0.03, 0.01, beta2=0.98, keep_best=True)
LONG = Adam(100, 0.02, 0.003, beta2=0.98, keep_best=True)


@dataclass(frozen=True)
class LayoutConfig:
    """How the first scene is found."""

    shapes: int = 8
    """Shapes of each thing that the boxes judge."""
    keep: int = 3
    """Shapes of each thing that the silhouettes judge."""
    turns: int = 6
    """Starts of each of them."""
    screen: ScreenConfig = field(default_factory=ScreenConfig)
    """The quick look by boxes."""
    image: ImageConfig = field(default_factory=lambda: ImageConfig(size=96, form="robust"))
    """How the picture is sampled."""
    prepare: PrepareConfig = field(
        default_factory=lambda: PrepareConfig(faces=600, samples=200, region=20)
    )
    """How shapes are made fit."""
    place: PlaceConfig = field(
        default_factory=lambda: PlaceConfig(
            SceneWeights(1.0, 1.0, 0.3, 1.0, 0.0, 0.0), "robust", LONG, short=SHORT, keep=2
        )
    )
    """The descent by silhouettes."""


@record
class Picture:
    """What one picture shows."""

    camera: Camera
    detections: tuple[Detection, ...]
    masks: Bool[Tensor, "things h w"]
    """Of the detections; empty where only the box is known."""
    people: Bool[Tensor, "h w"]
    """Where people hide the room."""
    height: float | None
    """Of the camera above the floor, where it is known [m]."""
    depth: Float[Tensor, "h w"] | None
    """Measured distance along the view [m]; NaN: unknown. None: nothing was measured."""


@record
class Hypothesis:
    """One way in which a thing may stand."""

    piece: Piece
    energy: float
    """What is left of the image terms there."""


@record
class FirstScene:
    """The first scene, and what else is possible."""

    scene: Scene
    others: tuple[tuple[Hypothesis, ...], ...]
    """Of each piece, best first; the first is the one in the scene."""
    skipped: tuple[str, ...]
    """Classes of things that do not stand on the ground and were left out."""


def first_scene(
    picture: Picture, config: LayoutConfig, run: Run, meshes: Path | None = None
) -> FirstScene:
    """Place library furniture where a picture shows furniture.

    Args:
        picture: Detections in one picture.
        config: How.
        run: Keeps what is finished.
        meshes: The user's own shapes.
    """
    placed = [k for k, d in enumerate(picture.detections) if is_placed(d.category)]
    skipped = tuple(d.category for k, d in enumerate(picture.detections) if k not in placed)
    if not placed:
        return FirstScene(Scene(picture.camera, None, ()), (), skipped)
    picture = replace(
        picture,
        detections=tuple(picture.detections[k] for k in placed),
        masks=picture.masks[placed],
    )
    shapes = [shapes_of(d.category, config.shapes, meshes) for d in picture.detections]
    cues = run.stage(find_image_cues, _image(picture), config.image)
    pairs = [(thing, shape) for thing, known in enumerate(shapes) for shape in known]
    screened = run.stage(screen, _screen_inputs(picture, cues, pairs), config.screen)
    camera = replace(picture.camera, R_cam_world=screened.R_cam_world)
    picture = replace(picture, camera=camera)
    items = best_items(screened, [thing for thing, _ in pairs], config.keep)
    things = torch.tensor([pairs[k][0] for k in items])
    pieces = _pieces(picture, [pairs[k] for k in items])
    prepared = run.stage(prepare_objects, PrepareInputs(pieces), config.prepare)
    starts = starts_of(screened, items, config.turns)
    inputs = _place_inputs(picture, repeated(cues, things), prepared, starts, screened.height)
    placed = run.stage(place_objects, inputs, config.place)
    found = restore(pieces, prepared, placed.layout)
    return _scene(picture, (found, things, placed.energy[0]), screened.height, skipped)


def _image(picture: Picture) -> ImageInputs:
    count = len(picture.detections)
    boxes = torch.stack([d.box for d in picture.detections])
    unordered = torch.zeros(count, count, dtype=torch.bool)
    seen = torch.ones(count, dtype=torch.bool)
    return ImageInputs(picture.camera, boxes, seen, picture.masks, picture.people, unordered)


def _screen_inputs(
    picture: Picture, cues: ImageCues, pairs: list[tuple[int, Shape]]
) -> ScreenInputs:
    height = picture.height
    if height is None and picture.depth is not None:
        things = picture.masks.any(0) | picture.people
        height = floor_height(picture.depth, picture.camera, things)
    return ScreenInputs(
        camera=picture.camera,
        boxes=cues.boxes,
        sides=cues.sides,
        depth=median_depths(picture.depth, picture.masks),
        thing=torch.tensor([thing for thing, _ in pairs]),
        points=torch.stack([outer_points(shape) for _, shape in pairs]),
        height=height,
    )


def _pieces(picture: Picture, pairs: list[tuple[int, Shape]]) -> tuple[Piece, ...]:
    """One piece for each item; the name tells thing and rank."""
    found: list[Piece] = []
    for index, (thing, shape) in enumerate(pairs):
        rank = sum(1 for other, _ in pairs[:index] if other == thing)
        found.append(piece_of(picture.detections[thing], shape, f"{thing}_{rank}"))
    return tuple(found)


def _place_inputs(
    picture: Picture, cues: ImageCues, prepared: Prepared, starts: Layout, height: float
) -> PlaceInputs:
    depth = None
    if picture.depth is not None:
        depth = range_in(picture.depth, cues, picture.camera, SLACK)
    return PlaceInputs(
        prepared.objects, picture.camera, -height, cues, HumanCues(depth=depth), starts,
        starts.yaw[0],
    )  # fmt: skip


def _scene(
    picture: Picture,
    found: tuple[tuple[Piece, ...], Int[Tensor, " items"], Float[Tensor, " items"]],
    height: float,
    skipped: tuple[str, ...],
) -> FirstScene:
    """The best item of each thing, and the others behind it."""
    pieces, things, energy = found
    count: Counter[str] = Counter()
    groups: list[tuple[Hypothesis, ...]] = []
    for thing, detection in enumerate(picture.detections):
        word = canonical(detection.category).replace(" ", "_")
        name = f"{word}_{count[word]}"
        count[word] += 1
        own = sorted((things == thing).nonzero()[:, 0].tolist(), key=lambda k: float(energy[k]))
        groups.append(tuple(Hypothesis(replace(pieces[k], id=name), float(energy[k])) for k in own))
    scene = Scene(picture.camera, -height, tuple(group[0].piece for group in groups))
    return FirstScene(scene, tuple(groups), skipped)
