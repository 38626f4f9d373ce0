"""Errors of body regression: depth, pose and place, slow or fast in time; missing frames."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool, Float

from ..bodies import open_body
from ..geometry.runs import decode
from ..records import map_tensors
from ..types import Bodies, BodyPose
from .known import KnownRoom, rounded
from .noise_config import NoiseConfig
from .person import LEG
from .turns import from_vector, to_vector

LOST_SECONDS = 2.0  # memory of what loses them; a stretch lasts about a second


def noisy_bodies(room: KnownRoom, noise: NoiseConfig, rng: np.random.Generator) -> Bodies:
    """Bodies as a network would see them, skinned anew from wrong pose parameters."""
    bodies = room.bodies
    assert bodies.pose is not None, "a known room has parameters"
    pose = map_tensors(lambda x: x.double(), bodies.pose)
    count = len(bodies.frame)
    error = slow(rng, bodies, (22, 3), noise.pose_seconds) * np.radians(noise.pose)
    hidden = hidden_rows(room) if noise.pose_hidden != 1 else np.zeros(count, dtype=bool)
    error = error * np.where(hidden, noise.pose_hidden, 1.0)[:, None, None]
    pose = _turned(pose, error)
    people = bodies.person.numpy()
    bias = 1 + noise.depth_bias * rng.uniform(-1, 1, int(people.max()) + 1)[people]
    drift = noise.depth_drift * slow(rng, bodies, (1,), 1.0)[:, 0]
    pelvis = open_body().posed(pose)[1][:, 0]
    shift = pelvis * torch.from_numpy(bias + drift - 1)[:, None]
    shift = shift + torch.from_numpy(noise.jitter * rng.normal(size=(count, 3)))
    pose = dataclasses.replace(pose, transl=pose.transl + shift)
    verts, joints = open_body().posed(pose)
    keep = torch.from_numpy(np.flatnonzero(rng.uniform(size=count) >= noise.dropped))
    return dataclasses.replace(
        bodies,
        verts=rounded(verts[keep]),
        joints=rounded(joints[keep]),
        frame=bodies.frame[keep],
        person=bodies.person[keep],
        pose=map_tensors(lambda x: rounded(x[keep]), pose),
    )


def lose_feet(bodies: Bodies, noise: NoiseConfig, rng: np.random.Generator) -> Bodies:
    """Legs below the knees guessed wrongly in some stretches of time."""
    if noise.lost_feet == 0:
        return bodies
    assert bodies.pose is not None, "bodies of known rooms have parameters"
    mood = slow(rng, bodies, (1,), LOST_SECONDS)[:, 0]
    lost = mood <= np.quantile(mood, noise.lost_feet)
    wrong = slow(rng, bodies, (22, 3), noise.pose_seconds) * np.radians(noise.lost_angle)
    below = np.isin(np.arange(22), [joint for leg in LEG for joint in leg[1:]])
    pose = map_tensors(lambda x: x.double(), bodies.pose)
    pose = _turned(pose, wrong * lost[:, None, None] * below[:, None])
    verts, joints = open_body().posed(pose)
    return dataclasses.replace(
        bodies, verts=rounded(verts), joints=rounded(joints), pose=map_tensors(rounded, pose)
    )


def slow(
    rng: np.random.Generator, bodies: Bodies, shape: tuple[int, ...], seconds: float
) -> np.ndarray:
    """Noise (bodies, *shape) of variance one that forgets within `seconds` (Ornstein-Uhlenbeck)."""
    assert bodies.fps is not None, "a known room is a video"
    fresh = rng.normal(size=(len(bodies.frame), *shape))
    memory = np.exp(-1 / (bodies.fps * seconds))
    frame, person = bodies.frame.numpy(), bodies.person.numpy()
    last: dict[int, int] = {}
    for row in range(len(fresh)):  # each row builds on the one before
        before = last.get(int(person[row]))
        if before is not None:
            kept = memory ** float(frame[row] - frame[before])
            fresh[row] = kept * fresh[before] + np.sqrt(1 - kept**2) * fresh[row]
        last[int(person[row])] = row
    return fresh


def hidden_rows(room: KnownRoom) -> Bool[np.ndarray, " bodies"]:
    """Bodies of which less than half is seen, behind furniture or outside the image."""
    people = room.capture.people
    assert people is not None, "a known room has masks"
    seen = [int(decode(people.masks, row).sum()) for row in range(len(people.frame))]
    return np.array(seen) < 0.5 * room.whole.clamp_min(1).numpy()


def _turned(pose: BodyPose, error: Float[np.ndarray, "bodies 22 3"]) -> BodyPose:
    """Each joint's rotation followed by an error, as an axis-angle vector [rad]."""
    count = len(error)
    root = pose.global_orient.reshape(count, 1, 3)
    local = torch.cat([root, pose.body_pose.reshape(count, 21, 3)], 1).numpy()
    wrong = torch.from_numpy(to_vector(from_vector(local) @ from_vector(error)))
    return dataclasses.replace(
        pose, global_orient=wrong[:, 0], body_pose=wrong[:, 1:].reshape(count, -1)
    )
