"""Keypoints of bodies in the orders that 2D detectors use."""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..records import record
from . import BodyModel
from .marks import marks_of
from .skeleton import SIDES
from .smpl_model import SmplBody, skin_of_model

MISSING = ""
"""A keypoint that no model has."""


def _hand(side: str) -> tuple[str, ...]:
    """Wrist, thumb, index, middle, ring, little finger, from the root to the tip."""
    order = ("thumb", "index", "middle", "ring", "pinky")
    ends = ("1", "2", "3", "_tip")
    return (f"{side}_wrist", *(f"{side}_{finger}{k}" for finger in order for k in ends))


_LEFT, _RIGHT = _hand("left"), _hand("right")
_FACE = tuple(f"face_{k:02d}" for k in range(68))
_COCO = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear",
    *(f"{s}_{n}" for n in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle") for s in SIDES),
)  # fmt: skip
_BODY_25 = (
    "nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow",
    "left_wrist", "pelvis", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee",
    "left_ankle", "right_eye", "left_eye", "right_ear", "left_ear", "left_big_toe",
    "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
_FEET = _BODY_25[19:]

LAYOUTS: dict[str, tuple[str, ...]] = {
    "openpose25": _BODY_25,
    "openpose137": (*_BODY_25, *_LEFT, *_RIGHT, *_FACE, MISSING, MISSING),
    "smplifyx118": (*_BODY_25, *_LEFT, *_RIGHT, *_FACE[17:]),
    "coco17": _COCO,
    "halpe26": (
        *_COCO, "head_top", "neck", "pelvis",
        *(f"{side}_{n}" for n in ("big_toe", "small_toe", "heel") for side in SIDES),
    ),
    "wholebody133": (*_COCO, *_FEET, *_FACE, *_LEFT, *_RIGHT),
}  # fmt: skip
"""Names of the keypoints of each layout, in order.

`openpose137` is OpenPose's body, left hand, right hand and face of 70; `smplifyx118` the same with
the 51 inner points of the face. Faces are numbered as in iBUG's 68; 0 to 16 are the contour.
"""


@record
class Spots:
    """Keypoints as mixtures of up to three vertices, or as joints."""

    vertex: Int[Tensor, "keypoints 3"]
    share: Float[Tensor, "keypoints 3"]
    joint: Int[Tensor, " keypoints"]
    """The joint that a keypoint is; -1: it is a mixture of vertices."""
    there: Bool[Tensor, " keypoints"]
    """Keypoints that the model has."""


def keypoints_of(
    model: BodyModel,
    verts: Float[Tensor, "bodies verts 3"],
    joints: Float[Tensor, "bodies joints 3"],
    layout: str,
) -> Float[Tensor, "bodies keypoints 3"]:
    """Places of the keypoints of a layout [m]; NaN where the model has none.

    Hips, knees, shoulders and so on are the model's joints; nose, eyes, ears, toes, heels and tips
    of fingers are vertices; the face's inner points lie on SMPL-X's triangles.

    Args:
        model: The body model that was posed.
        verts: Its vertices, as `model.posed` gives them [m].
        joints: Its joints [m].
        layout: One of `LAYOUTS`.

    Raises:
        ValueError: If there is no such layout.
    """
    spots = spots_of(model, layout)
    device = verts.device
    vertex, share = spots.vertex.to(device), spots.share.to(verts)
    skin = (verts[:, vertex] * share[..., None]).sum(2)
    joint, there = spots.joint.to(device), spots.there.to(device)
    inside = torch.where((joint >= 0)[:, None], joints[:, joint.clamp_min(0)], skin)
    return torch.where(there[:, None], inside, torch.nan)


def has_keypoints(model: BodyModel, layout: str) -> Bool[Tensor, " keypoints"]:
    """Which keypoints of a layout the model has.

    Raises:
        ValueError: If there is no such layout.
    """
    return spots_of(model, layout).there


@lru_cache(maxsize=16)
def spots_of(model: BodyModel, layout: str) -> Spots:
    """Where the keypoints of a layout are on this model.

    Raises:
        ValueError: If there is no such layout.
    """
    if layout not in LAYOUTS:
        raise ValueError(f"no layout '{layout}', known are {', '.join(LAYOUTS)}")
    names = LAYOUTS[layout]
    vertex, share = torch.zeros(len(names), 3, dtype=torch.long), torch.zeros(len(names), 3)
    joint = torch.full((len(names),), -1)
    known = {name: k for k, name in enumerate(model.joint_names)}
    skin = skin_of_model(model)
    marks = {} if skin is None else marks_of(skin)
    face = model.face if isinstance(model, SmplBody) else None
    for k, name in enumerate(names):
        point = int(name[5:]) - 17 if name.startswith("face_") else -1
        if name in known:
            joint[k] = known[name]
        elif name in marks:
            vertex[k], share[k, 0] = marks[name], 1
        elif face is not None and point >= 0:
            vertex[k], share[k] = face.vertex[point].cpu(), face.share[point].cpu()
    return Spots(vertex, share, joint, (joint >= 0) | (share.sum(1) > 0))
