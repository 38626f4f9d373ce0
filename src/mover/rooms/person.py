"""One person: the skeleton and the skin of the open body in one shape, in float64."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from ..bodies import open_body
from ..bodies.skeleton import JOINTS
from ..records import record
from ..types import BodyPose

AT = {name: k for k, name in enumerate(JOINTS)}
SIDES = ("left", "right")
LEG = tuple(tuple(AT[f"{s}_{j}"] for j in ("hip", "knee", "ankle", "foot")) for s in SIDES)
ARM = tuple(tuple(AT[f"{s}_{j}"] for j in ("shoulder", "elbow", "wrist")) for s in SIDES)
SPINE = tuple(AT[f"spine{k}"] for k in (1, 2, 3))


@record
class Person:
    """One body shape: its skeleton and skin in the T-pose."""

    betas: Float[np.ndarray, " shape"]
    joints: Float[np.ndarray, "55 3"]
    """[m], relative to the pelvis."""
    skin: Float[np.ndarray, "verts 3"]
    """[m], relative to the pelvis."""
    origin: Float[np.ndarray, "3"]
    """The pelvis of the rest shape: what `transl` leaves out [m]."""

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
        """Height of the pelvis of a person who stands with almost straight legs [m]."""
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
