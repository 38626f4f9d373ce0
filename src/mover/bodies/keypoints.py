"""Points of the skin that people click in pictures: nose, eyes, ears, toes, heels, finger tips.

Of models with a fixed mesh they are vertices known by number; of the open body they are found by
its geometry in the zero pose, so that any level of detail has them.
"""

from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies import BodyModel
from mover.bodies.skeleton import FINGERS, SIDES
from mover.bodies.skinning import SkinnedBody, zero_pose
from mover.bodies.smpl_model import SmplBody, skin_of_model
from mover.core.records import record

TIPS = tuple(f"{side}_{finger}_tip" for side in SIDES for finger in FINGERS)
HEAD_MARKS = ("nose", "right_eye", "left_eye", "right_ear", "left_ear")
FOOT_MARKS = tuple(f"{side}_{mark}" for side in SIDES for mark in ("big_toe", "small_toe", "heel"))
MARKS = (*HEAD_MARKS, *FOOT_MARKS, *TIPS, "head_top")
"""Names of all points."""

_NUMBERED = (*HEAD_MARKS, *FOOT_MARKS, *TIPS)
VERTEX_OF = {
    "smplx": dict(
        zip(
            _NUMBERED,
            (9120, 9929, 9448, 616, 6, 5770, 5780, 8846, 8463, 8474, 8635,
             4933, 5058, 5286, 5169, 5361, 7669, 7794, 8022, 7905, 8079),
            strict=True,
        )
    ),
    "smplh": dict(
        zip(
            _NUMBERED,
            (332, 6260, 2800, 4071, 583, 3216, 3226, 3387, 6617, 6624, 6787,
             2319, 2445, 2673, 2556, 2746, 5782, 5905, 6133, 6016, 6191),
            strict=True,
        )
    ),
}  # fmt: skip
"""Vertex of each point in the meshes of SMPL-X (10,475) and of SMPL and SMPL-H (6,890)."""


def marks_of(model: SkinnedBody) -> dict[str, int]:
    """Vertex of each point of `MARKS` that this body has."""
    known = VERTEX_OF.get("smplh" if model.name == "smpl" else model.name)
    top = _top(model)
    return {**known, "head_top": top} if known is not None else _found(model)


@lru_cache(maxsize=16)
def _top(model: SkinnedBody) -> int:
    """The highest vertex of the rest shape that moves with the head."""
    head = model.weights[:, model.joint_names.index("head")] > 0.5
    height = model.verts[:, 1].clone()
    height[~head] = -torch.inf
    return int((height if head.any() else model.verts[:, 1]).argmax())


@lru_cache(maxsize=16)
def _found(model: SkinnedBody) -> dict[str, int]:
    """Points by geometry, in the zero pose (T-pose, +y up, +z front)."""
    verts, joints = (x[0].detach() for x in model.posed(zero_pose(1, model)))
    place = dict(zip(model.joint_names, joints, strict=True))
    main = model.weights.argmax(1).cpu()

    def of(*names: str) -> Bool[Tensor, " verts"]:
        wanted = torch.tensor([model.joint_names.index(n) for n in names])
        return torch.isin(main, wanted).to(verts.device)

    head = of("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")
    marks = _head_marks(verts, head, place)
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        foot = of(f"{side}_ankle", f"{side}_foot")
        ball = place[f"{side}_foot"]
        outward, front = sign * (verts[:, 0] - ball[0]), verts[:, 2] - ball[2]
        low = verts[:, 1] < verts[foot, 1].min() + 0.04
        toes = foot & (front > 0.02)
        marks[f"{side}_big_toe"] = _most(front, toes & (outward < -0.01))
        marks[f"{side}_small_toe"] = _most(outward + 0.7 * front, toes & (outward > 0.02))
        marks[f"{side}_heel"] = _most(-verts[:, 2], foot & low)
        for finger in FINGERS:
            end = place[f"{side}_{finger}3"]
            along = (verts - end) @ (end - place[f"{side}_{finger}2"])
            marks[f"{side}_{finger}_tip"] = _most(along, of(f"{side}_{finger}3"))
    return marks


def _head_marks(
    verts: Float[Tensor, "verts 3"], head: Bool[Tensor, " verts"], place: dict[str, Tensor]
) -> dict[str, int]:
    """Nose, eyes, ears, and the top of the head."""
    x, y, z = verts.unbind(-1)
    eyes = place["left_eye_smplhf"][1]
    marks = {
        "nose": _most(z, head & (x.abs() < 0.012) & (y < eyes) & (y > eyes - 0.06)),
        "head_top": _most(y, head),
    }
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        eye = place[f"{side}_eye_smplhf"]
        near = (verts - eye)[:, :2].norm(dim=-1)
        marks[f"{side}_eye"] = _most(-near, head & (z > eye[2]))
        ear = head & (sign * x > 0.9 * (sign * x[head]).max()) & (y < eyes + 0.03)
        marks[f"{side}_ear"] = _most(-(verts - verts[ear].mean(0)).norm(dim=-1), ear)
    return marks


def _most(score: Float[Tensor, " verts"], among: Bool[Tensor, " verts"]) -> int:
    """The vertex of the highest score."""
    return int(torch.where(among, score, -torch.inf).argmax())


# Keypoints of bodies in the orders that 2D detectors use.


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
