"""The parts of a capture as the stages want them."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.runs import decode
from ..records import map_tensors, record
from ..types import Bodies, BodyPose, Capture, Masks
from .prepare_objects import Prepared


@record
class Seen:
    """The detections of the pieces, in the order of the scene."""

    boxes: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]; the whole image where there is no detection."""
    detected: Bool[Tensor, " objects"]
    masks: Bool[Tensor, "objects h w"]
    """Empty where only the box is known."""
    people: Bool[Tensor, "h w"]
    """People in the reference image."""


def image_evidence(capture: Capture) -> Seen:
    """Line the detections up with the pieces of the scene."""
    camera, pieces = capture.scene.camera, capture.scene.pieces
    by_id = {d.id: d for d in capture.detections}
    found = [by_id.get(-1 if p.annotation is None else p.annotation) for p in pieces]
    whole = torch.tensor([0.0, 0.0, camera.width, camera.height])
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if d is None or d.mask is None else decode(d.mask, 0) for d in found]
    people = blank
    if capture.reference_people is not None:
        for row in range(len(capture.reference_people.counts)):
            people = people | decode(capture.reference_people, row)
    return Seen(
        torch.stack([whole if d is None else d.box for d in found]) if found else torch.zeros(0, 4),
        torch.tensor([d is not None for d in found], dtype=torch.bool),
        torch.stack(masks) if masks else blank.expand(0, -1, -1),
        people,
    )


def detected_masks(capture: Capture) -> Masks:
    """All masks of the reference image."""
    camera = capture.scene.camera
    found = [d.mask.counts[0] for d in capture.detections if d.mask is not None]
    return Masks(camera.height, camera.width, tuple(found))


def rows_of(bodies: Bodies, keep: Bool[Tensor, " bodies"]) -> Bodies:
    """Some rows of the bodies."""
    pose = bodies.pose
    if pose is not None:
        names = [f.name for f in dataclasses.fields(BodyPose) if f.name not in ("model", "gender")]
        some = map_tensors(lambda x: x[keep], {n: getattr(pose, n) for n in names})
        pose = dataclasses.replace(pose, **some)
    joints = None if bodies.joints is None else bodies.joints[keep]
    return dataclasses.replace(
        bodies, verts=bodies.verts[keep], joints=joints, frame=bodies.frame[keep],
        person=bodies.person[keep], pose=pose,
    )  # fmt: skip


def ground_without_people(capture: Capture, prepared: Prepared) -> float:
    """Height of the floor where no foot tells: given, or under the median object [m]."""
    if capture.camera_height is not None:
        return -capture.camera_height
    if capture.scene.ground is not None:
        return capture.scene.ground
    return float(prepared.start.t_world_object[:, 1].median())
