"""A first scene from masks, boxes and classes of one picture, without any network.

1. Each detected thing gets a few shapes of its class: the library's designs, or the user's meshes.
2. Boxes alone constrain the camera's height and the possible shapes and turns (screen.py).
3. Silhouettes decide: the descent of the main job (Eq. 1 with its image terms alone, in the robust
   form) from several turns of several shapes of each thing, all at once.
Along what a thing may run counts in 2 and 3, as far as it is seen, and firm standard sizes in 3.

Everything stands on the ground. What is best becomes the scene; the next best shapes and places of
each thing are kept beside it.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.run import Run
from mover.core.types import (
    Camera,
    Detection,
    Heading,
    Layout,
    Mesh,
    Scene,
    SceneObject,
    Tilt,
)
from mover.energy.config import SceneConfig
from mover.energy.fused.energy import energy_function
from mover.energy.human_terms import DepthRange
from mover.energy.objective import HumanCues, ImageCues
from mover.energy.prior_terms import Given
from mover.furniture.library import WALL_PIECES, canonical, catalogue, choose_piece, meanings
from mover.geometry.camera import pitch_roll, to_world
from mover.geometry.crops import sample_nearest
from mover.geometry.mesh import box, used
from mover.geometry.raster import Crops
from mover.geometry.rotations import wrap
from mover.io.files.fields import At
from mover.io.files.meshes import KINDS, read_mesh
from mover.perceive.config import LayoutConfig
from mover.perceive.screen import Screened, ScreenInputs, outermost, screen
from mover.stages.camera.room_lines import Segments
from mover.stages.objects.find_image_cues import ImageInputs, find_image_cues, order_in_image
from mover.stages.objects.gather_given import given_axis, sizes_of_shapes, unplaced
from mover.stages.objects.own_edges import own_edges
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.place_objects import place_objects
from mover.stages.objects.prepare_objects import PrepareInputs, prepare_objects, to_objects
from mover.stages.objects.starts import facing
from mover.stages.posterior import Gaussian

OTHER_SIZES: dict[str, tuple[float, float, float]] = {
    "refrigerator": (0.70, 1.70, 0.70), "oven": (0.60, 0.90, 0.60), "toilet": (0.40, 0.78, 0.66),
    "potted plant": (0.50, 0.90, 0.50), "piano": (1.50, 1.15, 0.60), "bathtub": (1.60, 0.58, 0.75),
    "washing machine": (0.60, 0.86, 0.60), "box": (0.50, 0.40, 0.50),
    "bar stool": (0.42, 0.75, 0.42),
}  # fmt: skip
"""Usual width, height and depth of things that the library lacks [m]; they become blocks."""

NOT_ON_FLOOR = frozenset({
    "tv", "television", "laptop", "sink", "microwave", "toaster", "book", "vase", "clock", "pillow",
    "window", "door", "wall", "floor", "ceiling", "picture", "mirror", "curtain", "blinds",
    "keyboard", "mouse", "remote", "cell phone", "bottle", "cup", "bowl", "person",
})  # fmt: skip
"""What does not stand on the ground by itself: it is not placed."""

UNKNOWN_SIZE = (0.60, 0.80, 0.60)
SLACK = 0.05  # error of measured depth [share]
MOST_OFF = 1.5  # factor of a network's depth; what is farther off is no floor
SOUGHT = 0.04
"""Error of the scale of a first scene (rooms 100 to 104), as a logarithm."""
TURNED_APART = 0.6  # [rad], turns that are nearer count as one start
SAME = 1.05, 0.002  # times the energy, and beside it: an outline that is the same from behind
OFF = math.radians(2.0)  # of pitch and roll of first scenes, as in four scenes of i3DB [rad]
LEVEL = 0.92  # cosine of the largest tilt of a surface that counts as floor
CELL = 0.04  # [m], height of a slice in which floor is counted
ENOUGH = 0.25  # of the fullest slice: the lowest slice with so much is the floor


@dataclass(frozen=True)
class ShapeChoice:
    """One possible shape at its usual size."""

    mesh: Mesh
    file: str
    """Where it came from; empty: the library."""
    size: tuple[float, float, float]
    """Edges of its box [m]."""


def is_placed(category: str) -> bool:
    """Whether a thing of this class stands on the ground."""
    return canonical(category) not in NOT_ON_FLOOR


def shapes_of(category: str, count: int, folder: Path | None = None) -> tuple[ShapeChoice, ...]:
    """At most `count` shapes of a class that differ most in size and design.

    The user's meshes, named after their class (FOLDER/chair_0.obj), come before the library's.

    Raises:
        InputError: If a mesh cannot be read.
    """
    own = () if folder is None else _own_shapes(canonical(category), folder)
    if own:
        return _different(own, count)
    names = meanings(category)
    known = [
        ShapeChoice(piece.mesh, "", piece.size)
        for name in names
        for piece in catalogue(canonical(name))
    ]
    if not known:
        size = OTHER_SIZES.get(canonical(category), UNKNOWN_SIZE)
        return (ShapeChoice(choose_piece(category, size), "", size),)
    return _different(tuple(known), count)


def _different(shapes: tuple[ShapeChoice, ...], count: int) -> tuple[ShapeChoice, ...]:
    """The most usual shape, then always the one that is farthest from all that are taken."""
    if len(shapes) <= count:
        return shapes
    logs = np.log(np.array([shape.size for shape in shapes]))
    taken = [int(np.abs(logs - np.median(logs, axis=0)).sum(1).argmin())]
    far = np.full(len(shapes), np.inf)
    while len(taken) < count:
        far = np.minimum(far, np.square(logs - logs[taken[-1]]).sum(1))
        taken.append(int(far.argmax()))
    return tuple(shapes[k] for k in taken)


def _own_shapes(category: str, folder: Path) -> tuple[ShapeChoice, ...]:
    """The user's meshes of a class."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected meshes like chair_0.obj")
    found: list[ShapeChoice] = []
    for path in sorted(folder.iterdir()):
        name = path.stem.rstrip("0123456789_- ")
        if path.suffix.lower() in KINDS and canonical(name) == category:
            mesh, file = read_mesh(At(path.name, path.name), folder)
            low, high = box(used(mesh).verts)
            x, y, z = (high - low).tolist()
            found.append(ShapeChoice(mesh, file, (x, y, z)))
    return tuple(found)


def starts_of(screened: Screened, items: list[int], turns: int) -> Layout:
    """The best turns of each item, spread so that both fronts of a box are tried."""
    yaw = screened.layout.yaw[:, items]
    energy = screened.energy[:, items]
    picks = torch.stack([_apart(yaw[:, k], energy[:, k], turns) for k in range(len(items))], 1)
    wide = picks[..., None].expand(-1, -1, 3)
    return Layout(
        screened.layout.t_world_object[:, items].gather(0, wide),
        yaw.gather(0, picks),
        screened.layout.log_scale[:, items].gather(0, wide),
    )


def _apart(yaw: Float[Tensor, " yaws"], energy: Tensor, turns: int) -> Int[Tensor, " turns"]:
    """Indices of the best turns that differ; the best of the rest fill up."""
    kept: list[int] = []
    rest: list[int] = []
    for k in energy.argsort().tolist():
        near = [abs(float(wrap(yaw[k] - yaw[j]))) for j in kept]
        (kept if all(d > TURNED_APART for d in near) else rest).append(k)
    return torch.tensor((kept + rest)[:turns])


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
    prior: Gaussian | None = None
    """Of its tilt and height, from the feet of people."""
    reference: Float[Tensor, "h w 3"] | None = None
    """The picture itself, in [0, 1]."""
    tilt_spread: float | None = None
    """Standard deviation of pitch and roll where they were measured or lines show them [rad]."""
    heading: Heading | None = None
    """Heading of the room, where they constrain it."""
    segments: Segments | None = None
    """These lines."""


@record
class Hypothesis:
    """One way in which a thing may stand."""

    piece: SceneObject
    energy: float
    """What is left of the image terms there."""


@record
class FirstScene:
    """The first scene, and what else is possible."""

    scene: Scene
    others: tuple[tuple[Hypothesis, ...], ...]
    """Hypotheses of each object, best first; the first is the one in the scene."""
    skipped: tuple[str, ...]
    """Classes of things that do not stand on the ground and were left out."""

    @property
    def tilt(self) -> Tilt:
        """Of its camera, and how far off that may be."""
        pitch, roll = (float(a) for a in pitch_roll(self.scene.camera.R_cam_world.double()))
        return Tilt(pitch, roll, OFF)


def first_scene(
    picture: Picture, config: LayoutConfig, run: Run, meshes: Path | None = None
) -> FirstScene:
    """Place furniture of the library, or of the folder `meshes`, where a picture shows some."""
    placed = [k for k, d in enumerate(picture.detections) if is_placed(d.category)]
    skipped = tuple(d.category for k, d in enumerate(picture.detections) if k not in placed)
    if not placed:
        return FirstScene(Scene(picture.camera, None, ()), (), skipped)
    found = tuple(picture.detections[k] for k in placed)
    picture = at_scale(replace(picture, detections=found, masks=picture.masks[placed]))
    shapes = [shapes_of(d.category, config.shapes, meshes) for d in picture.detections]
    pairs = [(thing, shape) for thing, known in enumerate(shapes) for shape in known]
    boxes = torch.stack([d.box for d in picture.detections])
    masks, hidden = picture.masks, picture.people
    seen, behind = torch.ones(len(boxes), dtype=torch.bool), order_in_image(masks, hidden)
    image = ImageInputs(picture.camera, boxes, seen, masks, hidden, behind)
    cues = run.stage(find_image_cues, image, config.image)
    screened = run.stage(screen, _screen_inputs(picture, cues, pairs), config.screen)
    camera = replace(picture.camera, R_cam_world=screened.R_cam_world)
    picture = replace(picture, camera=camera)

    best, items = screened.energy.amin(0), list[int]()
    for thing in range(len(shapes)):  # the shapes of each thing that go on, best first
        own = [k for k, (owner, _) in enumerate(pairs) if owner == thing]
        items += sorted(own, key=lambda k: float(best[k]))[: config.keep]
    chosen = [pairs[k] for k in items]
    things = torch.tensor([thing for thing, _ in chosen])
    pieces = _pieces(picture, chosen)
    prepared = run.stage(prepare_objects, PrepareInputs(pieces), config.prepare)
    cues = _cues_of(picture, cues, chosen)
    depth = None if picture.depth is None else range_in(picture.depth, cues, camera, SLACK)
    starts = starts_of(screened, items, config.turns)
    inputs = PlaceInputs(
        prepared.objects, camera, -screened.height, cues, HumanCues(depth=depth), starts,
        starts.yaw[0],
    )  # fmt: skip
    found = run.stage(place_objects, inputs, config.place)
    layout = _turned_to_camera(found.layout, inputs, config)
    objects = to_objects(pieces, prepared, layout)
    others = _ranked(picture, objects, things, found.energy[0])
    scene_objects = tuple(group[0].piece for group in others)
    scene = Scene(camera, -screened.height, scene_objects, size_spread=SOUGHT)
    return FirstScene(scene, others, skipped)


def _turned_to_camera(layout: Layout, inputs: PlaceInputs, config: LayoutConfig) -> Layout:
    """Furniture along walls with its front to the room, where its outline is the same."""
    objects, place = inputs.objects, config.place
    other = replace(layout, yaw=wrap(layout.yaw + math.pi))
    terms = SceneConfig(place.weights, place.form, place.uniform_scale_weight)
    energy = energy_function(objects, inputs.camera, inputs.image, inputs.humans, terms)
    now, then = energy(Layout.cat(layout[None], other[None])).per_item.detach()
    along = torch.tensor([name in WALL_PIECES for name in objects.categories])
    away = facing(layout, torch.zeros(1, 3)) < 0
    turn = along & away & (then <= SAME[0] * now + SAME[1])
    return replace(layout, yaw=torch.where(turn, other.yaw, wrap(layout.yaw)))


def _pieces(picture: Picture, chosen: list[tuple[int, ShapeChoice]]) -> tuple[SceneObject, ...]:
    """One object for each shape of a thing; its id has thing and rank."""
    rank: Counter[int] = Counter()
    found: list[SceneObject] = []
    for thing, shape in chosen:
        detection = picture.detections[thing]
        found.append(
            SceneObject(
                id=f"{thing}_{rank[thing]}", category=detection.category, mesh=shape.mesh,
                mesh_file=shape.file, annotation=detection.id, support="ground",
                t_world_object=torch.zeros(3), yaw=torch.tensor(0.0), scale=torch.ones(3),
            )
        )  # fmt: skip
        rank[thing] += 1
    return tuple(found)


def _cues_of(picture: Picture, cues: ImageCues, chosen: list[tuple[int, ShapeChoice]]) -> ImageCues:
    """The cues of each shape's thing, with its likely axes and standard size."""
    things = torch.tensor([thing for thing, _ in chosen])
    kinds = [canonical(picture.detections[thing].category) for thing, _ in chosen]
    sizes = torch.tensor([shape.size for _, shape in chosen])
    standard, precision, slack = sizes_of_shapes(kinds, sizes)
    known = rows_of(axes_of(picture), things, "objects")
    known = replace(known, standard=standard, precision=precision, slack=slack)
    views = Crops(cues.views.K[things], cues.views.height, cues.views.width)
    return ImageCues(
        cues.boxes[things], cues.sides[things], views, cues.masks[things], cues.keep[things],
        cues.trust[things], given=known,
    )  # fmt: skip


def _ranked(
    picture: Picture,
    objects: tuple[SceneObject, ...],
    things: Int[Tensor, " items"],
    energy: Float[Tensor, " items"],
) -> tuple[tuple[Hypothesis, ...], ...]:
    """The hypotheses of each thing, best first, under its name."""
    count: Counter[str] = Counter()
    groups: list[tuple[Hypothesis, ...]] = []
    for thing, detection in enumerate(picture.detections):
        word = canonical(detection.category).replace(" ", "_")
        name = f"{word}_{count[word]}"
        count[word] += 1
        own = sorted((things == thing).nonzero()[:, 0].tolist(), key=lambda k: float(energy[k]))
        group = [Hypothesis(replace(objects[k], id=name), float(energy[k])) for k in own]
        groups.append(tuple(group))
    return tuple(groups)


def at_scale(picture: Picture) -> Picture:
    """The picture with its depth at the scale given by the known height of the camera.

    A network's depth is off by a factor for the whole picture, which its floor shows.
    """
    height = picture.height
    if height is None and picture.prior is not None:
        height = float(picture.prior.mean[2].exp())
    if picture.depth is None or height is None:
        return picture
    seen = floor_height(picture.depth, picture.camera, picture.masks.any(0) | picture.people)
    if seen is None or not 1 / MOST_OFF < height / seen < MOST_OFF:
        return picture
    return replace(picture, depth=picture.depth * (height / seen))


def _screen_inputs(
    picture: Picture, cues: ImageCues, pairs: list[tuple[int, ShapeChoice]]
) -> ScreenInputs:
    height = picture.height
    if height is None and picture.depth is not None:
        hidden = picture.masks.any(0) | picture.people
        height = floor_height(picture.depth, picture.camera, hidden)
    points = list[Tensor]()
    for _, shape in pairs:  # from the centre of its bottom
        verts = used(shape.mesh).verts
        low, high = box(verts)
        origin = torch.stack([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
        points.append(outermost(verts - origin).float())
    things = torch.tensor([thing for thing, _ in pairs])
    return ScreenInputs(
        camera=picture.camera, boxes=cues.boxes, sides=cues.sides,
        depth=median_depths(picture.depth, picture.masks), thing=things, points=torch.stack(points),
        height=height, tilt_spread=picture.tilt_spread, prior=picture.prior,
        given=rows_of(axes_of(picture), things, "objects"),
    )  # fmt: skip


def axes_of(picture: Picture) -> Given:
    """Likely axes of each thing, from the edges of the room and of the thing."""
    kinds = [canonical(found.category) for found in picture.detections]
    if picture.heading is None or picture.segments is None:
        return unplaced(len(kinds))
    edges = own_edges(picture.segments, picture.masks, picture.people, picture.camera)
    return given_axis(kinds, picture.heading, edges)


def median_depths(
    depth: Float[Tensor, "h w"] | None, masks: Bool[Tensor, "things h w"]
) -> Float[Tensor, " things"]:
    """Median over each mask [m]; NaN where nothing is known."""
    if depth is None:
        return torch.full((len(masks),), torch.nan)
    rows = [depth[mask & depth.isfinite()] for mask in masks]
    return torch.stack([row.median() if len(row) else depth.new_tensor(torch.nan) for row in rows])


def range_in(
    depth: Float[Tensor, "h w"], cues: ImageCues, camera: Camera, slack: float
) -> DepthRange:
    """Bounds on the front surfaces in the masks: measured depth [m; NaN: unknown], -+ `slack`."""
    count = len(cues.boxes)
    images = sample_nearest(depth.nan_to_num(0.0), cues.views, camera.K, 0.0)
    known = (images > 0) & (cues.masks > 0.5)
    infinity = torch.full_like(images, torch.inf)
    near = torch.where(known, images * (1 - slack), -infinity)
    far = torch.where(known, images * (1 + slack), infinity)
    return DepthRange(near, far, torch.ones(count))


def floor_height(
    depth: Float[Tensor, "h w"], camera: Camera, things: Bool[Tensor, "h w"]
) -> float | None:
    """Height of the camera above the lowest level surface of the picture [m]; None: there is none.

    Furniture and people (`things`) are left out.
    """
    step = max(1, camera.width // 320)
    rows, columns = torch.arange(0, camera.height, step), torch.arange(0, camera.width, step)
    z = depth[rows][:, columns].double()
    y, x = torch.meshgrid(rows + 0.5, columns + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1).double()
    points = to_world(
        z[..., None] * (rays @ torch.linalg.inv(camera.K.double()).mT), camera.R_cam_world.double()
    )
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = torch.linalg.cross(down, across)
    level = normal[..., 1].abs() / normal.norm(dim=-1).clamp_min(1e-9) > LEVEL
    free = ~things[rows][:, columns][1:-1, 1:-1]
    heights = points[1:-1, 1:-1, 1][level & free & points[1:-1, 1:-1, 1].isfinite()]
    heights = heights[heights < 0]
    if len(heights) < 50:
        return None
    slices = ((heights - heights.min()) / CELL).long()
    counts = torch.bincount(slices)
    full = int((counts >= ENOUGH * counts.max()).nonzero()[0])
    near = (slices - full).abs() <= 1
    return -float(heights[near].median())
