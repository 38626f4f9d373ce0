"""From what a person wants (pelvis here, feet there, hands on the table) to joint angles.

A person is the skeleton and the skin of the open body in one shape. A posture is given by places;
the limbs follow by the law of cosines. All in float64 and in the frame of the floor: +y up, the
floor at y = 0. Rotations of many frames are about axes, from frames of axes, half-way, as vectors.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.skeleton import JOINTS, PARENTS
from mover.bodies.skinning import SkinnedBody, open_body
from mover.core.records import record
from mover.core.types import BodyPose

Turns = Float[np.ndarray, "... 3 3"]
Vectors = Float[np.ndarray, "... 3"]
Angles = Float[np.ndarray, "..."]

X, Y, Z = np.eye(3)


def about(axis: Float[np.ndarray, "3"], angle: Angles) -> Turns:
    """Right-handed rotations about one of the unit axes; `angle` in [rad]."""
    return from_vector(np.asarray(angle)[..., None] * axis)


def from_vector(vector: Vectors) -> Turns:
    """Rotation matrices of axis-angle vectors [rad]."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(vector / np.maximum(angle, 1e-12), -1, 0)
    o = np.zeros_like(x)
    skew = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    angle = angle[..., None]
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def to_vector(turn: Turns) -> Vectors:
    """Axis-angle vectors [rad] of rotation matrices, angles in [0, pi]."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(turn.shape[:-1])


def between(start: Turns, end: Turns, share: Angles) -> Turns:
    """The shortest way from `start` (share 0) to `end` (share 1)."""
    step = to_vector(np.swapaxes(start, -1, -2) @ end)
    return start @ from_vector(np.asarray(share)[..., None] * step)


def unit(vector: Vectors) -> Vectors:
    """Vectors of length one."""
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)


def frame(first: Vectors, second: Vectors) -> Turns:
    """Right-handed axes: `first`, the part of `second` square to it, and their product."""
    a = unit(first)
    b = unit(second - (second * a).sum(-1, keepdims=True) * a)
    return np.stack([a, b, np.cross(a, b)], -1)


def apply(turn: Turns, vector: Vectors) -> Vectors:
    """Rotated vectors."""
    return (turn @ vector[..., None])[..., 0]


def smooth(share: Angles) -> Angles:
    """Ease in and out: 0 to 1 with no speed and no acceleration at both ends."""
    s = np.clip(share, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def heading_of(direction: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    """Angle about +y that turns +z into a direction on the floor (x, z) [rad]."""
    return np.asarray(np.arctan2(direction[..., 0], direction[..., 1]))


def facing(heading: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 2"]:
    """Direction on the floor (x, z) of a heading."""
    return np.stack([np.sin(heading), np.cos(heading)], -1)


def left_of(heading: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 2"]:
    """Direction on the floor (x, z) to the left of a heading."""
    return np.stack([np.cos(heading), -np.sin(heading)], -1)


AT = {name: k for k, name in enumerate(JOINTS)}
SIDES = ("left", "right")
LEG = tuple(tuple(AT[f"{s}_{j}"] for j in ("hip", "knee", "ankle", "foot")) for s in SIDES)
ARM = tuple(tuple(AT[f"{s}_{j}"] for j in ("shoulder", "elbow", "wrist")) for s in SIDES)
SPINE = tuple(AT[f"spine{k}"] for k in (1, 2, 3))


@record
class Person:
    """One body shape: its skeleton and skin in the T-pose."""

    betas: Float[np.ndarray, " shape"]
    joints: Float[np.ndarray, "55 3"]  #: [m], relative to the pelvis
    skin: Float[np.ndarray, "verts 3"]  #: [m], relative to the pelvis
    origin: Float[np.ndarray, "3"]  #: the pelvis of the rest shape: what `transl` leaves out [m]

    @property
    def leg(self) -> float:
        """From hip to ankle along the straight leg [m]."""
        return _length(self.joints, LEG[0][:3])

    @property
    def arm(self) -> float:
        """From shoulder to wrist along the straight arm [m]."""
        return _length(self.joints, ARM[0])

    @property
    def ankle(self) -> float:
        """Height of the ankle above the sole [m]."""
        return float(self.joints[LEG[0][2], 1] - self.skin[:, 1].min())

    @property
    def standing(self) -> float:
        """Pelvis height of a standing person with almost straight legs [m]."""
        hip = self.joints[LEG[0][0]]
        spread = hip[0] - STANCE
        return self.ankle - float(hip[1]) + float(np.sqrt((0.988 * self.leg) ** 2 - spread**2))


STANCE = 0.085  # [m], half the distance between the ankles of a standing person


def _length(joints: np.ndarray, chain: Sequence[int]) -> float:
    return float(np.linalg.norm(np.diff(joints[list(chain)], axis=0), axis=1).sum())


def make_person(betas: Sequence[float]) -> Person:
    """A person with these shape coefficients of the open body."""
    shape = torch.tensor(betas, dtype=torch.float64)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    flat = torch.zeros(1, 63, dtype=torch.float64)
    pose = BodyPose("makehuman", "neutral", shape[None], zero, flat, zero, {})
    verts, joints = open_body().posed(pose)
    origin = joints[0, 0].numpy()
    return Person(shape.numpy(), joints[0].numpy() - origin, verts[0].numpy() - origin, origin)


REACH = 0.995  # a limb is never quite straight


@record
class Posture:
    """What the body does in each frame; sides are (left, right)."""

    pelvis: Float[np.ndarray, "frames 3"]  #: place of the pelvis [m]
    turn: Float[np.ndarray, "frames 3 3"]  #: rotation of the pelvis
    spine: Float[np.ndarray, "frames 3"]
    """Forward bend, turn to the left, lean to the right of the trunk [rad]."""
    head: Float[np.ndarray, "frames 2"]  #: nod and turn to the left of the head [rad]
    ankles: Float[np.ndarray, "frames 2 3"]  #: places of the ankles [m]
    feet: Float[np.ndarray, "frames 2 3 3"]  #: rotations of the feet
    toes: Float[np.ndarray, "frames 2"]  #: bend of the toes, up is positive [rad]
    knees: Float[np.ndarray, "frames 2 3"]  #: where the knees point
    wrists: Float[np.ndarray, "frames 2 3"]
    """Places of the wrists from the shoulders, in the axes of the chest [m]."""
    elbows: Float[np.ndarray, "frames 2 3"]  #: where the elbows point, in the axes of the chest
    palms: Float[np.ndarray, "frames 2 3"]  #: places of wrists that rest on something [m]
    resting: Float[np.ndarray, "frames 2"]
    """1: the hand lies flat at `palms`; 0: it follows `wrists`."""


def rows(posture: Posture, index: np.ndarray | slice) -> Posture:
    """Some frames of a posture."""
    return Posture(**{name: value[index] for name, value in vars(posture).items()})


def chain(postures: Sequence[Posture]) -> Posture:
    """One after the other."""
    names = vars(postures[0])
    return Posture(**{n: np.concatenate([getattr(p, n) for p in postures]) for n in names})


def blend(start: Posture, end: Posture, share: Float[np.ndarray, " frames"]) -> Posture:
    """Frames on the way from one posture (one frame each) to another."""
    out: dict[str, np.ndarray] = {}
    for name, a in vars(start).items():
        b = getattr(end, name)
        if name in ("turn", "feet"):
            out[name] = between(a, b, share if name == "turn" else share[:, None])
        else:
            w = share.reshape(-1, *[1] * (a.ndim - 1))
            out[name] = (1 - w) * a + w * b
    return Posture(**out)


def moved(posture: Posture, offset: np.ndarray) -> Posture:
    """The whole body elsewhere: `offset` is one vector, or one a frame [m]."""
    shift = np.broadcast_to(offset, posture.pelvis.shape)
    ankles, palms = posture.ankles + shift[:, None], posture.palms + shift[:, None]
    return dataclasses.replace(posture, pelvis=posture.pelvis + shift, ankles=ankles, palms=palms)


def angles(person: Person, posture: Posture) -> BodyPose:
    """Joint angles of the open body, in the frame of the floor (float64)."""
    turns = _world_turns(person, posture)
    local = np.stack(
        [turns[:, j] if p < 0 else np.swapaxes(turns[:, p], 1, 2) @ turns[:, j]
         for j, p in enumerate(PARENTS[:22])], 1,
    )  # fmt: skip
    vectors = torch.from_numpy(to_vector(local))
    frames = len(vectors)
    return BodyPose(
        model="makehuman", gender="neutral", extra={},
        betas=torch.from_numpy(person.betas).expand(frames, -1).clone(),
        global_orient=vectors[:, 0], body_pose=vectors[:, 1:].reshape(frames, -1),
        transl=torch.from_numpy(posture.pelvis - person.origin),
    )  # fmt: skip


def skinned(
    person: Person, posture: Posture, part: Bool[np.ndarray, " verts"] | None = None
) -> Float[np.ndarray, "frames kept 3"]:
    """The skin, or a part of it, in the frame of the floor [m]."""
    model = open_body() if part is None else _with_verts(torch.from_numpy(part))
    return model.posed(angles(person, posture))[0].numpy()


def jointed(person: Person, posture: Posture) -> Float[np.ndarray, "frames 22 3"]:
    """The joints of the body in the frame of the floor [m]."""
    return _with_verts(slice(1)).posed(angles(person, posture))[1][:, :22].numpy()


def _with_verts(keep: Tensor | slice) -> SkinnedBody:
    """The open body with some of its vertices."""
    model = open_body()
    few = {name: getattr(model, name)[keep] for name in ("verts", "weights", "shape_dirs")}
    return dataclasses.replace(model, **few)


def chest_of(person: Person, posture: Posture) -> tuple[np.ndarray, np.ndarray]:
    """Rotation of the chest, and the places of both shoulders [m]."""
    turns, place = _trunk(person, posture)
    chest, at = turns[SPINE[2]], place[SPINE[2]]
    shoulders = [at + apply(chest, person.joints[a[0]] - person.joints[SPINE[2]]) for a in ARM]
    return chest, np.stack(shoulders, 1)


def _trunk(person: Person, posture: Posture) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Rotation and place of the pelvis and the three joints of the spine."""
    bend, twist, lean = (posture.spine[:, k] / 3 for k in range(3))
    step = about(Y, twist) @ about(Z, -lean) @ about(X, bend)
    turns, place = {0: posture.turn}, {0: posture.pelvis}
    for joint in SPINE:
        parent = PARENTS[joint]
        bone = person.joints[joint] - person.joints[parent]
        place[joint] = place[parent] + apply(turns[parent], bone)
        turns[joint] = turns[parent] @ step
    return turns, place


def _world_turns(person: Person, posture: Posture) -> Float[np.ndarray, "frames 22 3 3"]:
    turns, _ = _trunk(person, posture)
    chest, shoulders = chest_of(person, posture)
    nod, look = posture.head[:, 0], posture.head[:, 1]
    turns[AT["neck"]] = chest @ about(Y, look / 2) @ about(X, nod / 2)
    turns[AT["head"]] = turns[AT["neck"]] @ about(Y, look / 2) @ about(X, nod / 2)
    for k, side in enumerate(SIDES):
        turns[AT[f"{side}_collar"]] = chest
        hip, knee, ankle, foot = LEG[k]
        start = posture.pelvis + apply(posture.turn, person.joints[hip])
        turns[hip], turns[knee] = _two_bones(
            person, LEG[k][:3], start, posture.ankles[:, k], posture.knees[:, k], X
        )
        turns[ankle] = posture.feet[:, k]
        turns[foot] = posture.feet[:, k] @ about(X, -posture.toes[:, k])
        turns.update(_arm_turns(person, posture, k, chest, shoulders[:, k]))
    return np.stack([turns[j] for j in range(22)], 1)


def _arm_turns(
    person: Person, posture: Posture, side: int, chest: np.ndarray, shoulder: np.ndarray
) -> dict[int, np.ndarray]:
    rest = posture.resting[:, side, None]
    free = shoulder + apply(chest, posture.wrists[:, side])
    goal = rest * posture.palms[:, side] + (1 - rest) * free
    hinge = -Y if side == 0 else Y
    pole = apply(chest, posture.elbows[:, side])
    upper, lower = _two_bones(person, ARM[side], shoulder, goal, pole, hinge)
    front = apply(posture.turn, Z) * np.array([1.0, 0, 1.0]) + 1e-6 * Z
    inward = 1.0 if side == 0 else -1.0
    flat = frame(inward * unit(front), np.broadcast_to(Y, front.shape))
    hand = between(lower, flat, posture.resting[:, side])
    return dict(zip(ARM[side], (upper, lower, hand), strict=True))


def _two_bones(
    person: Person, joints: Sequence[int], start: np.ndarray, goal: np.ndarray, pole: np.ndarray,
    hinge: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Rotations of two bones that lead from a start to a goal and bend towards a pole."""
    first = person.joints[joints[1]] - person.joints[joints[0]]
    second = person.joints[joints[2]] - person.joints[joints[1]]
    a, b = float(np.linalg.norm(first)), float(np.linalg.norm(second))
    span = goal - start
    far = np.clip(np.linalg.norm(span, axis=-1), abs(a - b) + 0.05, REACH * (a + b))[..., None]
    axes = frame(span, pole)
    along = (far**2 + a**2 - b**2) / (2 * far)
    out = np.sqrt(np.maximum(a**2 - along**2, 0))
    bone = along * axes[..., 0] + out * axes[..., 1]
    rest = far * axes[..., 0] - bone
    bend = np.cross(axes[..., 1], axes[..., 0])
    upper = frame(bone, bend) @ frame(first, hinge).T
    lower = frame(rest, bend) @ frame(second, hinge).T
    return upper, lower
