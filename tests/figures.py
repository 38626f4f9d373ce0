"""People in simple postures, of the open body."""

from dataclasses import replace

import torch

from mover.bodies.skeleton import JOINTS
from mover.bodies.skinning import open_body, zero_pose
from mover.core.types import Bodies, BodyPose

ARMS_DOWN = {"left_shoulder": (0.0, 0.0, -1.2), "right_shoulder": (0.0, 0.0, 1.2)}
SEATED = {
    **ARMS_DOWN,
    **{f"{s}_hip": (-1.5, 0.0, 0.0) for s in ("left", "right")},
    **{f"{s}_knee": (1.5, 0.0, 0.0) for s in ("left", "right")},
}
STRIDE = {
    **ARMS_DOWN,
    "left_hip": (-0.5, 0.0, 0.0),
    "right_hip": (0.3, 0.0, 0.0),
    "right_knee": (0.6, 0.0, 0.0),
}
ARMS_UP = {"left_shoulder": (0.0, 0.0, 1.3), "right_shoulder": (0.0, 0.0, -1.3)}
AT_TABLE = {**ARMS_DOWN, "left_elbow": (0.0, -1.5, 0.0), "right_elbow": (0.0, 1.5, 0.0)}

LEANING = {
    "left_shoulder": (0.702, -1.454, -0.702), "right_shoulder": (0.702, 1.454, 0.702),
    "left_elbow": (0.0, 0.0, 0.9), "right_elbow": (0.0, 0.0, -0.9),
}  # fmt: skip
"""Upper arms forwards and 52 degrees down, forearms level, palms down."""


def pose(turns: dict[str, tuple[float, float, float]], count: int = 1) -> BodyPose:
    """So many people with these joints turned from the T-pose [rad]."""
    rest = zero_pose(count, open_body())
    angles = rest.body_pose.reshape(count, 21, 3).clone()
    for name, turn in turns.items():
        angles[:, JOINTS.index(name) - 1] = torch.tensor(turn)
    return replace(rest, body_pose=angles.reshape(count, 63))


def turned(base: BodyPose, *turn: float) -> BodyPose:
    """The same with the whole body turned [rad]."""
    return replace(base, global_orient=torch.tensor([turn]).expand_as(base.global_orient))


def people(base: BodyPose, fps: float | None = None, floor: float = 0.0) -> Bodies:
    """Bodies in the world, one frame each, the lowest point of the first at `floor`."""
    model = open_body()
    verts, _ = model.posed(base)
    lift = floor - verts[0, :, 1].min()
    count = len(verts)
    return Bodies(
        verts=verts + torch.tensor([0.0, 1.0, 0.0]) * lift, faces=model.faces, joints=None,
        joint_names=(), frame=torch.arange(count), person=torch.zeros(count, dtype=torch.long),
        fps=fps, space="world", pose=base,
    )  # fmt: skip


def moving(bodies: Bodies, *step: float) -> Bodies:
    """The same people, moved by `step` from frame to frame [m]."""
    shift = torch.arange(len(bodies.verts))[:, None, None] * torch.tensor(step)
    return replace(bodies, verts=bodies.verts + shift)
