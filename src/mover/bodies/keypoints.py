"""Keypoints of bodies in the orders that 2D detectors use.

Nose, eyes, ears, toes, heels and finger tips are vertices known by number.
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies import BodyModel
from mover.bodies.skeleton import FINGERS, SIDES
from mover.bodies.skinning import SkinnedBody
from mover.core.records import record

TIPS = tuple(f"{side}_{finger}_tip" for side in SIDES for finger in FINGERS)
HEAD_MARKS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear")
FOOT_MARKS = tuple(f"{side}_{mark}" for side in SIDES for mark in ("big_toe", "small_toe", "heel"))
MARKS = (*HEAD_MARKS, *FOOT_MARKS, *TIPS, "head_top")
"""Names of all points."""
VERTEX_OF = {
    10475: (9120, 9929, 9448, 616, 6, 5770, 5780, 8846, 8463, 8474, 8635,
            4933, 5058, 5286, 5169, 5361, 7669, 7794, 8022, 7905, 8079),
    6890: (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787,
           2319, 2445, 2673, 2556, 2746, 5782, 5905, 6133, 6016, 6191),
    5002: (1904, 1844, 2479, 2022, 4534, 4349, 4933, 4618, 1864, 2423, 2123,
           3143, 3170, 3269, 3256, 3337, 669, 720, 853, 813, 862),
    13380: (5054, 6756, 13352, 5507, 12106, 11551, 13209, 12453, 4933, 6613, 5856,
            8595, 8787, 9171, 8982, 9348, 1927, 2119, 2503, 2314, 2680),
}  # fmt: skip
"""Vertices of all points but the top of the head by the size of the mesh: SMPL-X; SMPL and SMPL-H;
the open body, small and full."""


@lru_cache(maxsize=16)
def marks_of(model: SkinnedBody) -> dict[str, int]:
    """Vertex of each point of `MARKS`; the top of the head is the highest that moves with it."""
    marks = dict(zip(MARKS, VERTEX_OF[len(model.verts)], strict=False))
    head = model.weights[:, model.joint_names.index("head")] > 0.5
    height = torch.where(head, model.verts[:, 1], -torch.inf)
    return {**marks, "head_top": int((height if head.any() else model.verts[:, 1]).argmax())}


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
    "mediapipe33": (
        "nose", MISSING, "left_eye", MISSING, MISSING, "right_eye", MISSING, "left_ear",
        "right_ear", MISSING, MISSING, *_COCO[5:11], *(MISSING,) * 6, *_COCO[11:],
        "left_heel", "right_heel", "left_big_toe", "right_big_toe",
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
    there: Bool[Tensor, " keypoints"]  #: keypoints that the model has


def keypoints_of(
    model: BodyModel,
    verts: Float[Tensor, "bodies verts 3"],
    joints: Float[Tensor, "bodies joints 3"],
    layout: str,
) -> Float[Tensor, "bodies keypoints 3"]:
    """Places of the keypoints of a layout [m]; NaN where the model has none.

    Hips, knees, shoulders and so on are the model's joints; nose, eyes, ears, toes, heels and tips
    of fingers are vertices; the face's inner points lie on SMPL-X's triangles.

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


@lru_cache(maxsize=16)
def spots_of(model: BodyModel, layout: str) -> Spots:
    """Where the keypoints of a layout are on this model; see `keypoints_of`."""
    if layout not in LAYOUTS:
        raise ValueError(f"no layout '{layout}', known are {', '.join(LAYOUTS)}")
    names = LAYOUTS[layout]
    vertex, share = torch.zeros(len(names), 3, dtype=torch.long), torch.zeros(len(names), 3)
    joint = torch.full((len(names),), -1)
    known = {name: k for k, name in enumerate(model.joint_names)}
    marks = marks_of(model) if isinstance(model, SkinnedBody) else {}
    face = model.face if isinstance(model, SkinnedBody) else None
    for k, name in enumerate(names):
        point = int(name[5:]) - 17 if name.startswith("face_") else -1
        if name in known:
            joint[k] = known[name]
        elif name in marks:
            vertex[k], share[k, 0] = marks[name], 1
        elif face is not None and point >= 0:
            vertex[k], share[k] = face.vertex[point].cpu(), face.share[point].cpu()
    return Spots(vertex, share, joint, (joint >= 0) | (share.sum(1) > 0))
