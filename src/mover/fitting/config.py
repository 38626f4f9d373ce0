"""Weights, stages and choices of the fit of bodies."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Stage:
    """Weights of one stage; all are squared where SMPLify-X squares them."""

    pose: float = 4.78
    """Prior of the body's pose; the bending prior follows it (times 3.17)."""
    shape: float = 5.0
    """Numbers of the shape, and of the expression."""
    hands: float = 4.78
    """Prior of the hands."""
    jaw: float = 47.8
    """Prior of the jaw's opening; its other turns cost ten times as much."""
    hand_joints: float = 0.0
    """Factor on the confidence of keypoints of the hands."""
    face_joints: float = 0.0
    """Factor on the confidence of keypoints of the face."""
    smooth: float = 5.0
    """Constant-velocity terms."""
    steps: int = 30
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

    rho: float = 100.0
    """Residual at which the Geman-McClure price of a keypoint has halved [px], per 1,080 rows."""
    loose: float = 0.3
    """Factor on the confidence of neck and hips, which detectors place elsewhere (SMPLify-X: 0)."""
    least_confidence: float = 0.1
    """Keypoints below are missing."""
    least_joints: int = 4
    """Rows with fewer keypoints of the body are left out."""
    bending: float = 3.17
    """Multiple of the pose weight for elbows and knees bent the wrong way."""
    limits: float = 4.78
    """Weight of the ranges of motion."""
    sigma_joints: float = 0.1
    """sigma_2 of the paper: Geman-McClure's constant for second differences of 3D joints [m]."""
    sigma_pixels: float = 100.0
    """sigma_3 of the paper: the same for their projections [px]."""
    smooth_joints: float = 1.0
    """Weight of the smoothness of 3D joints, over the acceleration that people have."""
    smooth_pixels: float = 0.1
    """Weight of the smoothness of projections; confidence of the middle frame counts."""
    acceleration: float = 3.0
    """What joints of people do all the time [m/s²]."""
    jitter: float = 0.004
    """Second difference that is free of charge at any frame rate [m]."""
    longest_gap: float = 1.0
    """Frames further apart do not smooth each other [s]."""
    support: float = 0.05
    """Where the floor is known: how far a joint may be under it [m]."""
    near: float = 15.0
    """With bodies to start from: how far each angle may be from theirs [degrees]."""
    hands: int = 12
    """Principal components of each hand, where the model has them; else its angles are used."""
    chunk: int = 1000
    """Frames that are solved at once."""
    start_steps: int = 30
    """Iterations from each hypothesis of orientation and posture."""
    jump: float = 0.25
    """How far joints move about the pelvis between rows of a track that hypotheses explain [m]."""
    reach: float = 0.3
    """How far a pelvis is misplaced by a hypothesis [m]."""
    speed: float = 1.5
    """How fast a pelvis moves [m/s]."""
    switch: float = 10.0
    """Price of such a move, in squared standard deviations of the pose."""
    stages: tuple[Stage, ...] = field(default=STAGES)
    """Weights of the stages."""
