"""What undoes a fault of a capture: functions from captures to captures."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.types import Camera, Capture, Detection, Masks, SceneObject
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.rle import area, mask_boxes, run_lengths
from mover.io.capture.agreement import assigned, box_around, in_image, pairwise_iou2d
from mover.io.capture.scene_file import everywhere
from mover.io.capture.tracks import pair_tracks

LEAST = 0.2  # overlap of a body and the mask that it lies on
Mend = Callable[[Capture], Capture]
Change = Callable[[SceneObject], SceneObject]
Matrix = Float[Tensor, "3 3"]


def axes(rows: str) -> Matrix:
    """`x z -y` maps (x, y, z) to (x, z, -y)."""
    return torch.tensor([[(-1.0 if word[0] == "-" else 1.0) * (word[-1] == axis) for axis in "xyz"]
                         for word in rows.split()])  # fmt: skip


def each(change: Change, capture: Capture) -> Capture:
    """All objects changed, and their other hypotheses."""
    scene = capture.scene
    objects, others = (tuple(map(change, some)) for some in (scene.objects, capture.hypotheses))
    return replace(capture, scene=replace(scene, objects=objects), hypotheses=others)


def placed(A: Matrix, sign: float, one: SceneObject) -> SceneObject:
    """The upright object at its position in another world."""
    return everywhere(
        one, lambda at: {"t_world_object": A @ at.t_world_object, "yaw": sign * at.yaw}
    )


def baked(verts: Float[Tensor, "verts 3"], one: SceneObject) -> SceneObject:
    """The object whose mesh is placed already."""
    middle = (verts.amin(0) + verts.amax(0)) / 2
    return replace(
        one, mesh=replace(one.mesh, verts=verts - middle), mesh_file="", t_world_object=middle,
        yaw=torch.zeros(()), scale=torch.ones(3), segments=(),
    )  # fmt: skip


def remeshed(A: Matrix, one: SceneObject) -> SceneObject:
    """The object whose mesh has other axes."""
    mesh = replace(one.mesh, verts=one.mesh.verts @ A.mT)
    return replace(one, mesh=mesh, mesh_file="", scale=A.abs() @ one.scale)


def scaled(size: float, away: float) -> Change:
    """Objects of other sizes and at other distances."""

    def change(one: SceneObject) -> SceneObject:
        found = placed(away * torch.eye(3), 1, one)
        return replace(found, scale=found.scale * size)

    return change


def in_radians(one: SceneObject) -> SceneObject:
    """The object whose yaw was in degrees."""
    return everywhere(one, lambda at: {"yaw": at.yaw.deg2rad()})


def seen_by(camera: Camera, capture: Capture) -> Capture:
    """Another camera in the same world."""
    return replace(capture, scene=replace(capture.scene, camera=camera))


def tilt(sign: float, roll: float, capture: Capture) -> Capture:
    """The pitch of the other sign, and a further roll."""
    camera = capture.scene.camera
    pitch, old = pitch_roll(camera.R_cam_world)
    mended = seen_by(replace(camera, R_cam_world=tilted(sign * pitch, old + roll)), capture)
    if (known := capture.tilt) is None:
        return mended
    return replace(mended, tilt=replace(known, pitch=sign * known.pitch, roll=known.roll + roll))


def head_up(capture: Capture) -> Capture:
    """The other way up, with all that was placed before the camera."""
    new = tilt(-1, math.pi, capture)
    A = new.scene.camera.R_cam_world.mT @ capture.scene.camera.R_cam_world
    return each(partial(placed, A, -1), new)


def people(A: Matrix, capture: Capture) -> Capture:
    """Bodies in other axes of the camera, as meshes."""
    bodies = capture.bodies
    if bodies is None:
        return capture
    joints = None if bodies.joints is None else bodies.joints @ A.mT
    moved = replace(bodies, verts=bodies.verts @ A.mT, joints=joints, pose=None)
    return replace(capture, bodies=moved)


def frames(frame: Int[Tensor, " rows"], rate: float, shift: int) -> Int[Tensor, " rows"]:
    """Frames counted otherwise."""
    return (frame * rate).round().long() + shift


def retimed(rate: float, shift: int, track: int | None, capture: Capture) -> Capture:
    """Bodies in other frames, of one track or of all."""
    bodies = capture.bodies
    assert bodies is not None
    new = frames(bodies.frame, rate, shift)
    new = new if track is None else new.where(bodies.person == track, bodies.frame)
    return replace(capture, bodies=replace(bodies, frame=new))


def inverted_people(capture: Capture) -> Capture:
    """The background of people's masks."""
    seen = capture.people
    return replace(capture, people=replace(seen, masks=_inverted(seen.masks))) if seen else capture


def inverted_objects(capture: Capture, only: int | None = None) -> Capture:
    """The background of the furniture's masks, and its boxes; of one annotation or of all."""

    def other(one: Detection) -> Detection:
        if one.mask is None or only not in (None, one.id):
            return one
        mask = _inverted(one.mask)
        if not area(mask, 0):
            return one
        return replace(one, mask=mask, box=mask_boxes(mask)[0].to(one.box))

    return replace(capture, detections=tuple(map(other, capture.detections)))


def boxes_of_corners(capture: Capture) -> Capture:
    """Boxes whose widths and heights are their right and lower ends."""

    def other(one: Detection) -> Detection:
        box = torch.cat([one.box[:2], one.box[2:] - one.box[:2]])
        return replace(one, box=box) if bool((box[2:] > box[:2]).all()) else one

    return replace(capture, detections=tuple(map(other, capture.detections)))


def _inverted(masks: Masks) -> Masks:
    from pycocotools import mask as coco

    height, width, codes = masks.height, masks.width, list[bytes]()
    for code in masks.counts:
        runs = run_lengths(code)
        runs = runs[1:] if runs[0] == 0 else np.concatenate([[0], runs])
        tree: Any = {"counts": runs.tolist(), "size": [height, width]}
        codes.append(coco.frPyObjects(tree, height, width)["counts"])
    return replace(masks, counts=tuple(codes))


def same_tracks(capture: Capture) -> Capture:
    """Bodies and masks paired by their positions in the image."""
    bodies, seen = capture.bodies, capture.people
    if bodies is None or seen is None:
        return capture
    bodies, seen, notes = pair_tracks(bodies, seen, capture.scene.camera)
    return replace(capture, bodies=bodies, people=seen) if notes else capture


def by_masks(capture: Capture) -> Capture:
    """Bodies with the tracks of the masks that they lie on, where only those exchange places."""
    bodies, seen, camera = capture.bodies, capture.people, capture.scene.camera
    if bodies is None or seen is None:
        return capture
    person = bodies.person.clone()
    ours, theirs = in_image(box_around(bodies.verts, camera), camera), mask_boxes(seen.masks)
    for frame in bodies.frame.unique().tolist():
        a, b = ((one.frame == frame).nonzero()[:, 0] for one in (bodies, seen))
        if min(len(a), len(b)) < 2:
            continue
        pairs = assigned(pairwise_iou2d(ours[a].to(theirs), theirs[b]), LEAST)
        i, j = torch.tensor(pairs, dtype=torch.long).reshape(-1, 2).T
        if {*person[a[i]].tolist()} == {*seen.person[b[j]].tolist()}:
            person[a[i]] = seen.person[b[j]].to(person)
    same = bool((person == bodies.person).all())
    return capture if same else replace(capture, bodies=replace(bodies, person=person))
