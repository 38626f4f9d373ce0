"""How well scene, bodies and masks of a capture lie on each other, on a thinned copy of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from operator import attrgetter
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import rows_of
from mover.core.types import (
    Bodies,
    Camera,
    Capture,
    Keypoints,
    Masks,
    Mesh,
    People,
    SceneObject,
)
from mover.furniture.library import SIZES, canonical
from mover.geometry.boxes import iou2d
from mover.geometry.camera import NEAR, project, to_camera
from mover.geometry.mesh import used
from mover.geometry.rle import area, mask_boxes
from mover.geometry.rotations import rot_y

DIRECTIONS = 96  # in which the outermost points of a mesh are kept
MOST_OBJECTS, MOST_BODIES, MOST_MASKS, POSES = 40, 240, 40, 16
UPPER, LOWER = ("head", "neck"), "pelvis"
HEIGHTS = (0.8, 2.3)  # [m], of sitting children and standing adults
FULL_TURN = 2 * math.pi + 0.01  # [rad], a yaw beyond is hardly in radians
SEEN, JOINTS = 0.1, 4  # confidence of a joint that is seen, and how many make a person
SKIN = (0.05, 0.08, 0.05, 0.05)  # by so much of its longer side a body reaches beyond its joints


@dataclass(frozen=True)
class Agreement:
    """Shares from 0 to 1 of what fits; empty or NaN: there is nothing to compare."""

    objects: Float[Tensor, " annotated"]
    """Overlap of the outline's box with the annotation's, of objects that have one."""
    sizes: Float[Tensor, " known"]
    """How usual the size is of objects of known classes."""
    turns: Float[Tensor, " objects"]
    """Whether a yaw can be one in radians."""
    object_masks: Float[Tensor, " masked"]
    """0 for a mask of most of the picture, to its borders; as that of people below."""
    people_masks: Float[Tensor, " some"]
    people: Float[Tensor, " rows"]
    """Overlap of the box of a body with that of its mask; NaN where it has none."""
    heights: Float[Tensor, " bodies"]
    """How usual the height of a body is."""
    upright: Float[Tensor, " bodies"]
    """1 for a body that stands upright, 0 for one on its head; NaN without joints."""
    boxes: Float[Tensor, "bodies 4"]
    """Of bodies, beyond the image's borders, too [px]."""


NOTHING = Agreement(*[torch.zeros(0)] * 8, boxes=torch.zeros(0, 4))
SCORES = [field.name for field in fields(Agreement) if field.name != "boxes"]


def thinned_capture(capture: Capture) -> Capture:
    """Few points, objects and bodies, enough for all outlines."""
    scene, bodies, people = capture.scene, capture.bodies, capture.people
    if people is None and capture.keypoints is not None:
        people = around_joints(capture.keypoints, scene.camera)
    if people is not None and bodies is None:  # no time to compare
        few = torch.linspace(0, len(people.frame) - 1, MOST_BODIES).long().unique()
        people = rows_of(people, few)
    step = max(1, -(-len(scene.objects) // MOST_OBJECTS))
    objects = tuple(outermost(one) for one in scene.objects[::step])
    return replace(
        capture, scene=replace(scene, objects=objects), reference=None, touch=None, depth=None,
        bodies=None if bodies is None else _few_points(bodies), people=people, hypotheses=(),
        furniture=None,
    )  # fmt: skip


def around_joints(joints: Keypoints, camera: Camera) -> People:
    """People as the rectangles that bodies with these joints fill."""
    from pycocotools import mask as coco

    seen = joints.confidence > SEEN
    rows = seen.sum(1) >= JOINTS
    points, seen = joints.points[rows], seen[rows, :, None]
    low, high = (points.where(seen, torch.tensor(end)) for end in (math.inf, -math.inf))
    boxes = torch.cat([low.amin(1), high.amax(1)], -1)
    side = (boxes[:, 2:] - boxes[:, :2]).amax(1, keepdim=True)
    boxes = in_image(boxes + side * torch.tensor(SKIN) * torch.tensor([-1, -1, 1, 1]), camera)
    boxes[:, 2:] -= boxes[:, :2]
    codes: Any = coco.frPyObjects(boxes.double().numpy(), camera.height, camera.width)
    masks = Masks(camera.height, camera.width, tuple(code["counts"] for code in codes))
    return People(masks, joints.frame[rows], joints.person[rows])


def outermost(one: SceneObject) -> SceneObject:
    """The object with the outermost points of its mesh alone."""
    verts = used(one.mesh).verts
    few = verts[((verts * one.scale.abs()) @ _directions().mT.to(verts)).argmax(0)]
    return replace(one, mesh=Mesh(few, torch.arange(DIRECTIONS).reshape(-1, 3)))


@lru_cache(1)
def _directions() -> Float[Tensor, "directions 3"]:
    """Directions that lie evenly on a sphere (Fibonacci's spiral)."""
    k = torch.arange(DIRECTIONS) + 0.5
    y, turn = 1 - 2 * k / DIRECTIONS, k * math.pi * (1 + 5**0.5)
    r = (1 - y * y).sqrt()
    return torch.stack([r * turn.cos(), y, r * turn.sin()], -1)


def _few_points(bodies: Bodies) -> Bodies:
    """All bodies of some frames, with the vertices that are outermost in some of the poses."""
    frames, share = bodies.frame.unique(), min(1.0, MOST_BODIES / max(1, len(bodies.frame)))
    some = frames[torch.linspace(0, len(frames) - 1, math.ceil(share * len(frames))).long()]
    few = rows_of(replace(bodies, pose=None), torch.isin(bodies.frame, some))
    posed = few.verts[torch.linspace(0, len(few.verts) - 1, min(len(few.verts), POSES)).long()]
    points = (posed @ _directions()[::3].mT.to(posed)).argmax(1).unique()
    return replace(few, verts=few.verts[:, points], faces=torch.zeros(0, 3, dtype=torch.long))


def agreement(capture: Capture, other: tuple[Capture, Agreement] | None = None) -> Agreement:
    """How well the parts of a thinned capture agree; what is as in another is taken from it."""
    scene, bodies, people = capture.scene, capture.bodies, capture.people
    before, found = other or (None, NOTHING)

    def is_new(*parts: str) -> bool:
        reads = map(attrgetter, parts)
        return before is None or any(read(capture) is not read(before) for read in reads)

    if is_new("scene", "detections"):
        found = replace(
            found, objects=_overlaps(capture), sizes=_usual_sizes(scene.objects),
            turns=torch.tensor([float(abs(float(x.yaw)) < FULL_TURN) for x in scene.objects]),
        )  # fmt: skip
    if is_new("detections", "people"):
        people_masks = [] if people is None or not len(people.frame) else [people.masks]
        object_masks = [d.mask for d in capture.detections if d.mask is not None]
        found = replace(
            found, object_masks=bounded(object_masks), people_masks=bounded(people_masks)
        )
    if bodies is None:
        return found
    if is_new("scene.camera", "bodies.verts"):
        tall = (bodies.verts.amax(1) - bodies.verts.amin(1)).amax(-1)
        found = replace(
            found, boxes=box_around(bodies.verts, scene.camera),
            heights=_within(tall, *HEIGHTS), upright=_upright(bodies, scene.camera),
        )  # fmt: skip
    if is_new("scene.camera", "bodies", "people"):
        boxes = in_image(found.boxes, scene.camera)
        found = replace(found, people=_on_masks(boxes, bodies, people))
    return found


def _overlaps(capture: Capture) -> Float[Tensor, " annotated"]:
    """Overlaps of outlines and annotations; where no object has one, those of the best pairs."""
    objects, camera = capture.scene.objects, capture.scene.camera
    if not capture.detections or not objects:
        return torch.zeros(0)
    known, boxes = annotated(capture)
    ours = in_image(outlines(known or objects, camera), camera)
    if known:
        return iou2d(ours, boxes)
    shared = pairwise_iou2d(ours, torch.stack([d.box for d in capture.detections]))
    return torch.stack([shared[pair] for pair in assigned(shared)])


def annotated(capture: Capture) -> tuple[list[SceneObject], Float[Tensor, "objects 4"]]:
    """The objects that have an annotation, and its boxes."""
    boxes = {d.id: d.box for d in capture.detections}
    known = [one for one in capture.scene.objects if one.annotation in boxes]
    theirs = [boxes[key] for one in known if (key := one.annotation) is not None]
    return known, torch.stack(theirs) if theirs else torch.zeros(0, 4)


def pairwise_iou2d(
    a: Float[Tensor, "rows 4"], b: Float[Tensor, "columns 4"]
) -> Float[Tensor, "rows columns"]:
    """`iou2d` of each box with each other one."""
    return iou2d(*torch.broadcast_tensors(a[:, None], b[None]))


def assigned(shared: Float[Tensor, "rows columns"], least: float = 0.0) -> list[tuple[int, int]]:
    """Pairs of a row and a column with the greatest sum, of those that share enough."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(shared.numpy(), maximize=True)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return [(i, j) for i, j in pairs if shared[i, j] >= least]


def outlines(objects: Sequence[SceneObject], camera: Camera) -> Float[Tensor, "objects 4"]:
    """The rectangles around `outermost` points, beyond the image's borders, too [px]."""
    if not objects:
        return torch.zeros(0, 4)
    verts = torch.stack([one.mesh.verts * one.scale for one in objects])
    R, t = (torch.stack(x) for x in zip(*((rot_y(o.yaw), o.t_world_object) for o in objects),
                                        strict=True))  # fmt: skip
    verts = to_camera(verts @ R.mT + t[:, None], camera.R_cam_world)
    hidden = verts[..., 2] <= NEAR
    anyone = verts.gather(1, hidden.long().argmin(1)[:, None, None].expand(-1, -1, 3))
    found = box_around(torch.where(hidden[..., None], anyone, verts), camera)
    return torch.where(hidden.all(1, keepdim=True), torch.zeros(4), found)


def box_around(verts: Float[Tensor, "*b points 3"], camera: Camera) -> Float[Tensor, "*b 4"]:
    """x_min, y_min, x_max, y_max of points in camera axes [px]."""
    pixels = project(verts, camera.K)
    return torch.cat([pixels.amin(-2), pixels.amax(-2)], -1)


def in_image(boxes: Float[Tensor, "*b 4"], camera: Camera) -> Float[Tensor, "*b 4"]:
    """Boxes clipped to the image; without area where they are outside."""
    size = torch.tensor([camera.width, camera.height] * 2).to(boxes)
    return torch.minimum(boxes.clamp_min(0), size)


def _usual_sizes(objects: Sequence[SceneObject]) -> Float[Tensor, " known"]:
    """1 where height and longest side are those of its class, falling with the factor beyond."""
    known = [one for one in objects if canonical(one.category) in SIZES]
    if not known:
        return torch.zeros(0)
    verts = torch.stack([one.mesh.verts * one.scale for one in known])
    size = verts.amax(1) - verts.amin(1)
    low, high = torch.tensor([SIZES[canonical(one.category)] for one in known]).unbind(-1)
    high_and_long = [torch.stack([x[:, 1], x[:, [0, 2]].amax(1)]) for x in (size, low, high)]
    return _within(*high_and_long).mean(0)


def _within(
    value: Float[Tensor, "*n"], low: Float[Tensor, "*n"] | float, high: Float[Tensor, "*n"] | float
) -> Float[Tensor, "*n"]:
    """1 between two bounds, falling with the factor beyond."""
    value = value.clamp_min(1e-9)
    return torch.minimum(value / low, high / value).clamp_max(1)


def bounded(every: Sequence[Masks]) -> Float[Tensor, " masks"]:
    """0 for some of the masks that fill most of the picture to three of its borders, else 1."""
    found: list[float] = []
    for masks in every[:MOST_MASKS]:
        step = -(-len(masks.counts) // MOST_MASKS)
        few = replace(masks, counts=masks.counts[::step])
        low, high = mask_boxes(few).split(2, 1)
        size = torch.tensor([masks.width, masks.height])
        borders = (low <= 0).sum(1) + (high >= size).sum(1)
        for row, count in enumerate(borders.tolist()):
            found.append(float(count < 3 or 2 * area(few, row) < masks.width * masks.height))
    return torch.tensor(found)


def _on_masks(
    boxes: Float[Tensor, "bodies 4"], bodies: Bodies, people: People | None
) -> Float[Tensor, " bodies"]:
    """Overlap of the boxes of bodies and of their masks; NaN where a body has no mask."""
    found = torch.full((len(bodies.frame),), math.nan)
    if people is not None and len(people.frame):
        rows = partners(bodies.frame, bodies.person, people)
        both = rows >= 0
        found[both] = iou2d(boxes[both], mask_boxes(people.masks)[rows[both]])
    return found


def partners(
    frame: Int[Tensor, "*rows"], person: Int[Tensor, "*rows"], others: People | Bodies
) -> Int[Tensor, "*rows"]:
    """Row of the mask, or body, of a person in a frame, -1: none."""
    wide = 1 + max(int(person.max()), int(others.person.max()))
    ours, theirs = frame * wide + person, others.frame * wide + others.person
    order = theirs.argsort()
    row = order[torch.searchsorted(theirs[order], ours).clamp_max(len(order) - 1)]
    return torch.where(theirs[row] == ours, row, torch.full_like(row, -1))


def _upright(bodies: Bodies, camera: Camera) -> Float[Tensor, " bodies"]:
    """How far bodies stand upright in the world; NaN without joints."""
    names, joints = bodies.joint_names, bodies.joints
    upper = next((names.index(n) for n in UPPER if n in names), None)
    if joints is None or upper is None or LOWER not in names:
        return torch.full((len(bodies.frame),), math.nan)
    axis = joints[:, upper] - joints[:, names.index(LOWER)]
    return ((axis @ camera.R_cam_world[:, 1]) / axis.norm(dim=-1).clamp_min(1e-9) + 1) / 2
