"""The fit of bodies to keypoints: E_Body of the paper, in batch over the whole video.

This file has its weights, stages and choices. Imports no torch: `--help` is quick.
"""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from mover.core.settings import Count, Share, Sigma, Steps, Weight, float_in, int_in


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


PUBLISHED = (Stage(4.78, 5, 4.78, 47.8, 0.1, 0), Stage(4.78, 5, 4.78, 47.8, 2, 2))
"""The last two of the five stages of SMPLify-X's configuration for SMPL-X."""
STAGES = (
    Stage(20.0, 5.0, 57.4, 574, 0.0, 0.0, steps=120),
    Stage(4.78, 5.0, 4.78, 47.8, 0.1, 0.0, steps=280),
    Stage(4.78, 5.0, 4.78, 47.8, 1.0, 1.0, steps=80),
)
"""Ours: the orientation is searched before, so that fewer stages are needed."""


@dataclass(frozen=True)
class FitConfig:
    """What presets and experiments change in the fit of bodies to keypoints."""

    loose: Weight = 0.3
    """Factor on the confidence of neck and hips, which detectors place elsewhere (SMPLify-X: 0)."""
    left: Share = 0.45
    """Share of the variance of keypoints' noise that a fit leaves; 0: noise is as assumed."""
    noise_steps: Steps = 100
    """Iterations of the fit that estimates the noise, and of the one that estimates its bias."""
    limits: Weight = 4.78
    """Weight of the ranges of motion."""
    smooth_joints: Weight = 1.0
    """Weight of the smoothness of 3D joints, over the acceleration that people have."""
    smooth_pixels: Weight = 0.1
    """Weight of the smoothness of projections; confidence of the middle frame counts."""
    acceleration: Annotated[float, float_in(0, 1e4)] = 3.0
    """What joints of people do all the time [m/s²]."""
    still: Weight = 6.0
    """Weight of the smoothness of the pelvis, which does not move where its picture does not."""
    held: Weight = 1.0
    """Weight of the smoothness of trunk, head and arms about the pelvis, where they look still."""
    jitter: Sigma = 0.004
    """Second difference that is free of charge at any frame rate [m]."""
    by_size: bool = True
    """Second differences of joints in body sizes, so that smoothness pulls no person nearer."""
    independent_frames: Count = 4
    """Frames with independent errors: more do not constrain shape, stature and offsets further."""
    lasting: bool = True
    """Keypoints lie lastingly off the model's, and statures are those of adults (else the shape
    alone has a prior, as published)."""
    stands: Weight = 20.0
    """Weight of one floor below the lower soles of all bodies, found with them [1/m]; 0: none."""
    lies: Weight = 50.0
    """Weight of the distance before and after lying, for people lying along the view; 0: none."""
    chunk: Annotated[int, int_in(1, 100_000)] = 1000
    """Frames that are solved at once."""
    start_steps: Steps = 30
    """Iterations from each hypothesis of orientation and posture."""
    stages: tuple[Stage, ...] = STAGES
    """Weights of the stages."""


Preset = Literal["robust", "paper"]

PAPER = FitConfig(
    loose=0.0, left=0.0, limits=0.0, smooth_joints=1e2, smooth_pixels=1e-2, still=0.0, held=0.0,
    stands=0.0, lies=0.0, acceleration=0.0, jitter=1.0, by_size=False, independent_frames=1_000_000,
    lasting=False, stages=tuple(replace(stage, smooth=1.0, steps=300) for stage in PUBLISHED),
)  # fmt: skip
"""SMPLify-X and L_smooth (Sec. 3.2), in the two stages that the authors' fit of videos runs.

With no acceleration and a jitter of 1 m a second difference is divided by 1: it is weighted as
printed, by rho with sigma_2 = 0.1 m and sigma_3 = 100 px. lambda_smooth is not printed; here the
released code's 10^2 and 0.1^2. The printed pose prior is VPoser's: give its weights (`--vposer`).
"""

FITS: dict[Preset, FitConfig] = {"robust": FitConfig(), "paper": PAPER}
"""By name."""
