"""A scene against the truth: its objects one by one, and its camera.

Objects are compared in the gravity-aligned world of their own scene (docs/metrics.md).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import map_tensors, record
from mover.core.types import Camera, Mesh, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.boxes import Box, box_of, corners
from mover.geometry.boxes import iou2d as rectangle_iou
from mover.geometry.boxes import iou3d as box_iou
from mover.geometry.camera import NEAR, pitch_roll, project, to_camera
from mover.geometry.nearest import to_surface
from mover.geometry.placement import place_object
from mover.geometry.rotations import rot_y, wrap

T = TypeVar("T")
THINNEST = 1e-3  # [m], flat objects (rugs, pictures) count as this thick in the 3D IoU
SIDES: tuple[str, ...] = ("initial", "result")
PLASTIC = 1.32471795724474602596  # x³ = x + 1: its powers spread points evenly over a square
NEARER = 1e-3  # [1/m], boxes that do not overlap are paired by distance: this breaks the tie


@dataclass(frozen=True)
class Metric(Generic[T]):
    """One line of the table of metrics."""

    label: str
    unit: str  #: `m`, `rad`, `share` or nothing
    best: float  #: What a perfect reconstruction scores: 1 where more is better, 0 where less is
    measure: Callable[[T], float | None]
    """The value, or None where the truth that it needs is missing."""


@record
class Pair:
    """An object of a scene and the true object that it stands for."""

    estimate: SceneObject
    estimate_camera: Camera
    truth: SceneObject
    truth_camera: Camera
    samples: int  #: Number of points on the true surface
    boxes: bool = False  #: The truth is a box: boxes are compared in the image, not what is drawn


@record
class Sight:
    """An estimated scene and the true one, for their cameras."""

    estimate: Scene
    truth: Scene


def iou3d(pair: Pair) -> float:
    """Overlap of the two upright oriented boxes: intersection over union of their volumes."""
    return float(box_iou(thick(box_of(pair.estimate)), thick(box_of(pair.truth))))


def iou2d(pair: Pair) -> float | None:
    """Overlap in the image of the boxes around the two drawn meshes, both cut at its border.

    Where the truth is a box without a mesh (`Pair.boxes`) the two 3D boxes are drawn instead.
    """

    def box_mesh(item: SceneObject) -> Mesh:  # only the edges of its triangles are used
        return Mesh(corners(box_of(item)), torch.combinations(torch.arange(8), 3))

    shape = box_mesh if pair.boxes else place_object
    truth = image_box(pair.truth, pair.truth_camera, shape)
    estimate = image_box(pair.estimate, pair.estimate_camera, shape)
    if truth is None:
        return None
    return 0.0 if estimate is None else float(rectangle_iou(estimate, truth))


def p2s(pair: Pair) -> float:
    """Mean distance from points of the true surface to the estimated surface [m]."""
    points = area_samples(place_object(pair.truth), pair.samples)
    mesh = place_object(pair.estimate)
    return float(to_surface(points, mesh.verts, mesh.faces).mean())


def center_error(pair: Pair) -> float:
    """Distance between the centres of the two boxes [m]."""
    return float((box_of(pair.estimate).center - box_of(pair.truth).center).norm())


def pitch_error(sight: Sight) -> float:
    """Difference of the cameras' pitch [rad]."""
    pitch, true = (pitch_roll(s.camera.R_cam_world)[0] for s in (sight.estimate, sight.truth))
    return float((pitch - true).abs())


def roll_error(sight: Sight) -> float:
    """Difference of the cameras' roll [rad]."""
    roll, true = (pitch_roll(s.camera.R_cam_world)[1] for s in (sight.estimate, sight.truth))
    return float(wrap(roll - true).abs())


OBJECT_METRICS: dict[str, Metric[Pair]] = {
    "iou3d": Metric("3D overlap with the truth (IoU)", "", 1.0, iou3d),
    "iou2d": Metric("Overlap of the image boxes (IoU)", "", 1.0, iou2d),
    "p2s": Metric("True surface to estimated surface", "m", 0.0, p2s),
    "center_error": Metric("Error of the centre", "m", 0.0, center_error),
}
HARM_METRICS: dict[str, Metric[float]] = {
    "worse_by_10cm": Metric(
        "Objects more than 10 cm worse than initially",
        "share",
        0.0,
        lambda farther: float(farther > 0.1),
    )
}
"""Of how much farther from the truth an object's centre is than initially [m]; the mean is the
share of objects that were made worse."""
CAMERA_METRICS: dict[str, Metric[Sight]] = {
    "pitch_error": Metric("Error of the camera's pitch", "rad", 0.0, pitch_error),
    "roll_error": Metric("Error of the camera's roll", "rad", 0.0, roll_error),
}


def measure(table: Mapping[str, Metric[T]], subject: T) -> dict[str, float]:
    """Every metric of a table; what lacks its truth is left out."""
    values = {name: metric.measure(subject) for name, metric in table.items()}
    return {name: v for name, v in values.items() if v is not None and math.isfinite(v)}


def area_samples(mesh: Mesh, count: int) -> Float[Tensor, "count 3"]:
    """Points of a surface that stand for equal shares of its area, without random numbers.

    Thin boards get as many points on each side as wide ones: the mean over the points is the mean
    over the surface.
    """
    a, b, c = mesh.verts[mesh.faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1).double().cumsum(0)
    steps = torch.arange(count, dtype=torch.float64) + 0.5
    face = torch.searchsorted(area, steps / count * area[-1]).clamp_max(len(area) - 1)
    u, v = (steps * PLASTIC**-1 % 1).to(a), (steps * PLASTIC**-2 % 1).to(a)
    u, v = torch.where(u + v > 1, 1 - u, u)[:, None], torch.where(u + v > 1, 1 - v, v)[:, None]
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def match(
    estimate: Scene, truth: Scene, known: Mapping[str, str], by_place: bool = True
) -> dict[str, SceneObject]:
    """Say which estimated object stands for which true one.

    Names decide first: `known` are ids of estimated objects by those of true ones. What they leave
    over is paired one to one within its class (`by_place`) so that the sum of the overlaps, in 3D
    and in the image, is greatest; without overlap the nearer one wins.

    Returns:
        The estimated object by id of the true one; a true object that is missing is not in it.
    """
    by_id = {item.id: item for item in estimate.objects}
    found = {p.id: by_id[known[p.id]] for p in truth.objects if known.get(p.id) in by_id}
    if not by_place:
        return found
    taken = {item.id for item in found.values()}
    rest = [p for p in truth.objects if p.id not in found]
    free = [p for p in estimate.objects if p.id not in taken]
    for category in sorted({canonical(p.category) for p in rest}):
        ours = [p for p in free if canonical(p.category) == category]
        theirs = [p for p in rest if canonical(p.category) == category]
        found |= _assign(ours, estimate.camera, theirs, truth.camera)
    return found


def image_box(
    item: SceneObject, camera: Camera, shape: Callable[[SceneObject], Mesh] = place_object
) -> Float[Tensor, "4"] | None:
    """Box around the drawn mesh, cut at the image border, as shares of its width and height.

    None: nothing of the mesh is on the image.
    """
    mesh = shape(item)
    faces, points_cam = mesh.faces, to_camera(mesh.verts, camera.R_cam_world)
    ends = points_cam[torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])]
    depth = ends[..., 2]
    cut = (depth[:, 0] < NEAR) != (depth[:, 1] < NEAR)  # edges are cut where they come nearer
    start, stop = ends[cut].unbind(1)
    share = (NEAR - start[:, 2:]) / (stop[:, 2:] - start[:, 2:])
    visible = torch.cat([ends[depth >= NEAR], start + share * (stop - start)])
    if len(visible) == 0:
        return None
    size = torch.tensor([camera.width, camera.height]).to(visible)
    pixels = project(visible, camera.K) / size
    low, high = pixels.amin(0).clamp(0, 1), pixels.amax(0).clamp(0, 1)
    return torch.cat([low, high]) if bool((low < high).all()) else None


def _assign(
    ours: list[SceneObject], our_camera: Camera, theirs: list[SceneObject], their_camera: Camera
) -> dict[str, SceneObject]:
    """The pairing of one class with the greatest sum of overlaps."""
    from scipy.optimize import linear_sum_assignment

    pairs = [[Pair(a, our_camera, b, their_camera, 0) for a in ours] for b in theirs]
    gain = [[iou3d(p) + (iou2d(p) or 0.0) - NEARER * center_error(p) for p in row] for row in pairs]
    if not ours:
        return {}
    rows, columns = linear_sum_assignment(gain, maximize=True)
    return {theirs[row].id: ours[column] for row, column in zip(rows, columns, strict=True)}


def thick(box: Box) -> Box:
    """The box, at least as thick as flat objects count."""
    return Box(box.center, box.size.clamp_min(THINNEST), box.yaw)


def pairs(
    initial: Scene, result: Scene, truth: Scene, by_place: bool = True
) -> tuple[dict[str, SceneObject], dict[str, SceneObject]]:
    """Initial objects and those of the result by true id; settled on the initial scene."""
    same = {item.id: item.id for item in truth.objects}
    before = match(initial, truth, same, by_place)
    known = same | {name: item.id for name, item in before.items()}
    return before, match(result, truth, known, by_place)


def unmatched(
    initial: Scene, result: Scene, truth: Scene, by_place: bool = True
) -> dict[str, list[str]]:
    """Ids of true objects that the result lacks, and of its objects that stand for no true one.

    Returns:
        `missed`, which count as IoU 0 in the means, and `false`, which are in no mean.
    """
    found = pairs(initial, result, truth, by_place)[1]
    partners = {item.id for item in found.values()}
    return {
        "missed": [item.id for item in truth.objects if item.id not in found],
        "false": [item.id for item in result.objects if item.id not in partners],
    }


def measure_objects(
    scenes: tuple[Scene, Scene, Scene],
    found: Mapping[str, Mapping[str, SceneObject]],
    sides: Sequence[str],
    samples: int,
    boxes: bool = False,
) -> list[dict[str, Any]]:
    """Each true object of three scenes on some of the `SIDES`, as `pairs` has `found` them.

    `samples` points stand for each true surface; `boxes`: the truth has no meshes.
    """
    initial, result, truth = scenes
    cameras = {"initial": initial.camera, "result": result.camera}

    def of(side: str, true: SceneObject) -> dict[str, float]:
        item = found[side].get(true.id)
        if item is None:  # scores 0 in overlaps, if the truth has them
            shown = image_box(true, truth.camera) is not None
            return {"iou3d": 0.0, "iou2d": 0.0} if shown else {"iou3d": 0.0}
        pair = Pair(item, cameras[side], true, truth.camera, samples, boxes)
        given = found["initial"].get(true.id)
        values = measure(OBJECT_METRICS, pair)
        if given is None:
            return values
        before = center_error(Pair(given, initial.camera, true, truth.camera, samples))
        return values | measure(HARM_METRICS, values["center_error"] - before)

    return [{"id": true.id} | {side: of(side, true) for side in sides} for true in truth.objects]


def means_of(objects: Sequence[dict[str, Any]], side: str) -> dict[str, float]:
    """Means over those objects that have the metric."""
    names = (*OBJECT_METRICS, *HARM_METRICS)
    values = {n: [item[side][n] for item in objects if n in item[side]] for n in names}
    return {name: sum(found) / len(found) for name, found in values.items() if found}


# Overlap after one similarity: what the scale and position of the whole scene cost.
#
# A video does not determine how large a room is: people of unknown height and a guessed lens make
# all of it too large or too small at once. This separates that error from those of single objects.


def doubled(value: T) -> T:
    """In double precision."""
    return map_tensors(lambda x: x.double() if x.is_floating_point() else x, value)


FEWEST = 3  # objects: fewer would always fit
ROUNDS = 20  # of weights
CLOSE = 0.05  # [m], smaller residuals have the same weight
STRETCH = (0.5, 2.0)  # range of the scale


@record
class Together:
    """All objects of a scene that stand for true ones."""

    pairs: tuple[Pair, ...]
    missing: int  #: True objects that nothing stands for: they count as 0


@record
class _Similarity:
    """Upright: turned, scaled and moved."""

    yaw: Float[Tensor, ""]
    scale: Float[Tensor, ""]
    away: Float[Tensor, "3"]


def iou3d_aligned(scene: Together) -> float | None:
    """Mean overlap of the boxes after the similarity that brings most centres together.

    It is found by reweighted least squares.
    """
    if len(scene.pairs) < FEWEST:
        return None
    ours = [doubled(box_of(pair.estimate)) for pair in scene.pairs]
    true = [doubled(box_of(pair.truth)) for pair in scene.pairs]
    centres, aims = (torch.stack([box.center for box in boxes]) for boxes in (ours, true))
    by = _weighted(centres, aims, torch.ones_like(centres[:, 0]))
    for _ in range(ROUNDS):  # to the least sum of distances
        there = by.scale * (centres @ rot_y(by.yaw).mT) + by.away
        by = _weighted(centres, aims, 1 / (there - aims).norm(dim=-1).clamp_min(CLOSE))
    total = 0.0
    for box, aim in zip(ours, true, strict=True):
        centre = by.scale * (rot_y(by.yaw) @ box.center) + by.away
        carried = Box(centre, by.scale * box.size, box.yaw + by.yaw)
        total += float(box_iou(thick(carried), thick(aim)))
    return total / (len(scene.pairs) + scene.missing)


def _weighted(
    ours: Float[Tensor, "n 3"], true: Float[Tensor, "n 3"], weight: Float[Tensor, " n"]
) -> _Similarity:
    share = (weight / weight.sum())[:, None]
    middle, aim = (share * ours).sum(0), (share * true).sum(0)
    a, b = ours - middle, true - aim
    along = (share[:, 0] * (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2])).sum()
    across = (share[:, 0] * (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2])).sum()
    yaw = torch.atan2(across, along)
    turned = a @ rot_y(yaw).mT
    scale = (share * turned * b).sum() / (share * turned.square()).sum().clamp_min(1e-12)
    scale = scale.clamp(*STRETCH)
    return _Similarity(yaw, scale, aim - scale * (rot_y(yaw) @ middle))


SCENE_METRICS: dict[str, Metric[Together]] = {
    "iou3d_aligned": Metric("3D overlap after one similarity of all", "", 1.0, iou3d_aligned)
}
