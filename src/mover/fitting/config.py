"""How far joints turn: a pose prior from anatomy, which needs no file of anybody.

    E_pose(θ) = Σ_k ((θ_k - rest_k) / spread_k)² + Σ_k (stiffness · excess_k)²

θ are axis-angle components of the 21 joints of the body about the axes of the T-pose (+x to the
person's left, +y up, +z to the front). Ranges are the normal ranges of motion of the American
Academy of Orthopaedic Surgeons ("Joint Motion", 1965) and of Kapandji ("The Physiology of the
Joints"), rounded; ranges of spine and neck are shared among their joints. Rest and spread are ours:
a person with hanging arms, and half of the range that daily life uses.
"""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.skeleton import BODY
from mover.core.settings import Seconds, Share, Sigma, Steps, Weight, float_in, int_in

Range = tuple[float, float, float, float]
"""Lowest angle, highest angle, rest and spread [degrees]."""

_SPINE = ((-12, 30, 3, 10), (-17, 17, 0, 7), (-13, 13, 0, 6))
_NECK = ((-30, 30, 5, 14), (-40, 40, 0, 16), (-23, 23, 0, 8))
LEFT: dict[str, tuple[Range, Range, Range]] = {
    "hip": ((-125, 30, -25, 38), (-45, 50, 5, 14), (-30, 48, 2, 13)),
    "knee": ((-5, 150, 30, 42), (-12, 12, 0, 6), (-8, 8, 0, 4)),
    "ankle": ((-25, 50, -5, 14), (-22, 22, 0, 9), (-22, 22, 0, 8)),
    "foot": ((-45, 25, 0, 10), (-6, 6, 0, 3), (-6, 6, 0, 3)),
    "collar": ((-8, 8, 0, 4), (-16, 16, 0, 7), (-12, 32, 0, 8)),
    "shoulder": ((-95, 80, 5, 28), (-130, 45, -15, 32), (-100, 80, -62, 28)),
    "elbow": ((-60, 70, 0, 22), (-150, 5, -42, 40), (-12, 12, 0, 8)),
    "wrist": ((-60, 60, 0, 20), (-30, 25, 0, 10), (-70, 75, 0, 18)),
}
"""Limits of the left joints about x, y and z; the right ones mirror them."""
MIDDLE: dict[str, tuple[Range, Range, Range]] = {
    "spine1": _SPINE, "spine2": _SPINE, "spine3": _SPINE, "neck": _NECK, "head": _NECK,
}  # fmt: skip
"""Limits of the joints in the middle of the body."""
STIFFNESS = 1 / math.radians(4.0)  # beyond a limit four degrees are one standard deviation


def limits_of(joint: str) -> tuple[Range, Range, Range]:
    """Limits, rest and spread of a joint of the body about x, y and z [degrees]."""
    if joint in MIDDLE:
        return MIDDLE[joint]
    side, name = joint.split("_")
    x, y, z = LEFT[name]
    return (x, y, z) if side == "left" else (x, _mirrored(y), _mirrored(z))


def _mirrored(limit: Range) -> Range:
    low, high, rest, spread = limit
    return (-high, -low, -rest, spread)


@lru_cache(maxsize=1)
def limit_table() -> Float[Tensor, "4 63"]:
    """Lowest, highest, rest and spread of all angles of the body [rad]."""
    rows = [axis for name in BODY[1:] for axis in limits_of(name)]
    return torch.deg2rad(torch.tensor(rows, dtype=torch.float64)).mT.contiguous()


def limit_price(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, " bodies"]:
    """Squared excess over the ranges of motion, in units of `1 / STIFFNESS`; 0 within them."""
    low, high, _, _ = limit_table().to(angles)
    body = angles[:, :63]
    excess = (low - body).clamp_min(0) + (body - high).clamp_min(0)
    return (excess * STIFFNESS).square().sum(-1)


def resting(bodies: int, like: Tensor) -> Float[Tensor, "bodies 63"]:
    """A person who stands with hanging arms [rad]."""
    return limit_table()[2].to(like).expand(bodies, -1).clone()


def spreads(like: Tensor) -> Float[Tensor, "63"]:
    """How far each angle is from its rest in daily life [rad]."""
    return limit_table()[3].to(like)


# Weights, stages and choices of the fit of bodies.


@dataclass(frozen=True)
class Stage:
    """Weights of one stage; all are squared where SMPLify-X squares them."""

    pose: Weight = 4.78
    """Prior of the body's pose; the bending prior follows it (times 3.17)."""
    shape: Weight = 5.0
    """Numbers of the shape, and of the expression."""
    hands: Weight = 4.78
    """Prior of the hands."""
    jaw: Weight = 47.8
    """Prior of the jaw's opening; its other turns cost ten times as much."""
    hand_joints: Weight = 0.0
    """Factor on the confidence of keypoints of the hands."""
    face_joints: Weight = 0.0
    """Factor on the confidence of keypoints of the face."""
    smooth: Weight = 5.0
    """Constant-velocity terms."""
    steps: Steps = 30
    """Most iterations of L-BFGS."""


PUBLISHED = (
    Stage(404, 100, 404, 4.04e3, 0, 0),
    Stage(404, 50, 404, 4.04e3, 0, 0),
    Stage(57.4, 10, 57.4, 574, 0, 0),
    Stage(4.78, 5, 4.78, 47.8, 0.1, 0),
    Stage(4.78, 5, 4.78, 47.8, 2, 2),
)
"""The stages of SMPLify-X's configuration for SMPL-X."""
STAGES = (
    Stage(20.0, 5.0, 57.4, 574, 0.0, 0.0, steps=120),
    Stage(4.78, 5.0, 4.78, 47.8, 0.1, 0.0, steps=280),
    Stage(4.78, 5.0, 4.78, 47.8, 1.0, 1.0, steps=80),
)
"""Ours: the orientation is searched before, so that fewer stages are needed."""


@dataclass(frozen=True)
class FitConfig:
    """How bodies are fitted to keypoints."""

    rho: Sigma = 100.0
    """Residual at which the Geman-McClure price of a keypoint has halved [px], per 1,080 rows."""
    loose: Weight = 0.3
    """Factor on the confidence of neck and hips, which detectors place elsewhere (SMPLify-X: 0)."""
    least_confidence: Share = 0.1
    """Keypoints below are missing."""
    least_joints: Annotated[int, int_in(1, 133)] = 4
    """Rows with fewer keypoints of the body are left out."""
    bending: Weight = 3.17
    """Multiple of the pose weight for elbows and knees bent the wrong way."""
    limits: Weight = 4.78
    """Weight of the ranges of motion."""
    sigma_joints: Sigma = 0.1
    """sigma_2 of the paper: Geman-McClure's constant for second differences of 3D joints [m]."""
    sigma_pixels: Sigma = 100.0
    """sigma_3 of the paper: the same for their projections [px]."""
    smooth_joints: Weight = 1.0
    """Weight of the smoothness of 3D joints, over the acceleration that people have."""
    smooth_pixels: Weight = 0.1
    """Weight of the smoothness of projections; confidence of the middle frame counts."""
    acceleration: Annotated[float, float_in(1e-3, 1e4)] = 3.0
    """What joints of people do all the time [m/s²]."""
    still: Weight = 4.0
    """Weight of the smoothness of the pelvis, which does not move where its picture does not."""
    calm: Sigma = 0.05
    """Acceleration of a body whose picture stands still [m/s²],"""
    agility: Weight = 2.0
    """and what each m/s, across the view, adds to it [1/s]."""
    jitter: Sigma = 0.004
    """Second difference that is free of charge at any frame rate [m]."""
    longest_gap: Seconds = 1.0
    """Frames further apart do not smooth each other [s]."""
    support: Sigma = 0.05
    """Where the floor is known: how far a joint may be under it [m]."""
    near: Annotated[float, float_in(1e-3, 180)] = 15.0
    """With bodies to start from: how far each angle may be from theirs [degrees]."""
    hands: Annotated[int, int_in(0, 45)] = 12
    """Principal components of each hand, where the model has them; else its angles are used."""
    chunk: Annotated[int, int_in(1, 100_000)] = 1000
    """Frames that are solved at once."""
    start_steps: Steps = 30
    """Iterations from each hypothesis of orientation and posture."""
    jump: Sigma = 0.25
    """How far joints move about the pelvis between rows of a track that hypotheses explain [m]."""
    reach: Sigma = 0.3
    """How far a pelvis is misplaced by a hypothesis [m]."""
    speed: Sigma = 1.5
    """How fast a pelvis moves [m/s]."""
    switch: Weight = 10.0
    """Price of such a move, in squared standard deviations of the pose."""
    stages: tuple[Stage, ...] = field(default=STAGES)
    """Weights of the stages."""
