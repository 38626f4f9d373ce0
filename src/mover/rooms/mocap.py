"""Motion capture on the open body: bones point where the actor's bones point.

Only files that the user has are read; none comes with this package.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from ..bodies import open_body
from ..bodies.skeleton import PARENTS
from ..records import InputError, map_tensors
from ..types import Bodies, BodyPose
from .known import rounded
from .mocap_files import ROOT, Motion, Skeleton, euler, read_motion, read_skeleton
from .person import AT, Person, make_person
from .turns import Y, from_vector, to_vector, unit

RATE = 120.0  # [1/s], frames of the library of Carnegie Mellon University
FLOOR = 0.02  # share of frames whose lowest point may be under the floor

ACTOR = {
    "pelvis": ROOT, "spine1": "lowerback", "spine2": "upperback", "spine3": "thorax",
    "neck": "upperneck", "head": "head",
} | {
    f"{side}_{joint}": side[0] + bone
    for side in ("left", "right")
    for joint, bone in (
        ("hip", "femur"), ("knee", "tibia"), ("ankle", "foot"), ("foot", "toes"),
        ("shoulder", "humerus"), ("elbow", "radius"), ("wrist", "wrist"),
    )
}  # fmt: skip
"""The actor's bone that turns each joint; other joints follow their parents."""
ENDS = {"hip": "knee", "knee": "ankle", "shoulder": "elbow", "elbow": "wrist"}
"""Joints whose bone, up to the next joint, takes the direction of the actor's bone."""


def retarget(asf: Path, amc: Path, fps: float) -> Bodies:
    """One person who moves like the actor of a clip; in a world with +y up and the floor at 0.

    The body is the mean shape of the open body. The way over the floor is scaled by the length of
    the legs.

    Args:
        asf: The actor's skeleton.
        amc: The clip, of 120 frames a second.
        fps: Frames a second of the result, at most 120.

    Raises:
        InputError: If a file is not what it should be.
        ValueError: If `fps` is not in (0, 120].
    """
    if not 0 < fps <= RATE:
        raise ValueError(f"fps is {fps}, expected more than 0 and at most {RATE:g}")
    skeleton = read_skeleton(asf)
    if lost := sorted(set(ACTOR.values()) - set(skeleton)):
        raise InputError(
            f"{asf.name}: has no bone {lost[0]}, expected the bones of CMU's skeletons"
        )
    motion = read_motion(amc, skeleton)
    count = int((len(motion.place) - 1) * fps / RATE) + 1
    index = np.round(np.arange(count) * RATE / fps).astype(int)
    motion = Motion(motion.place[index], {n: a[index] for n, a in motion.angles.items()})
    return _on_floor(_pose(make_person([0.0] * 10), skeleton, motion), fps)


def _on_floor(pose: BodyPose, fps: float) -> Bodies:
    """One person, moved so that the feet stand on the floor."""
    model = open_body()
    low = torch.quantile(model.posed(pose)[0][..., 1].amin(1), FLOOR)
    pose = dataclasses.replace(pose, transl=pose.transl - low * torch.from_numpy(Y))
    verts, joints = model.posed(pose)
    return Bodies(
        verts=rounded(verts),
        faces=model.faces,
        joints=rounded(joints),
        joint_names=model.joint_names,
        frame=torch.arange(len(verts)),
        person=torch.zeros(len(verts), dtype=torch.long),
        fps=fps,
        space="world",
        pose=map_tensors(rounded, pose),
    )


def _pose(person: Person, skeleton: Skeleton, motion: Motion) -> BodyPose:
    """Joint angles of the open body, the pelvis where the scaled root is."""
    turns = world_turns(skeleton, motion)
    rest = _rest(person, skeleton)
    world: list[np.ndarray] = []
    for joint, name in enumerate(list(AT)[:22]):
        parent = PARENTS[joint]
        world.append(turns[ACTOR[name]] @ rest[name] if name in ACTOR else world[parent])
    local = [
        turn if PARENTS[j] < 0 else np.swapaxes(world[PARENTS[j]], 1, 2) @ turn
        for j, turn in enumerate(world)
    ]
    vectors = torch.from_numpy(to_vector(np.stack(local, 1)))
    frames = len(vectors)
    leg = sum(skeleton[f"{s}{b}"].length for s in "lr" for b in ("femur", "tibia")) / 2
    transl = motion.place * person.leg / leg - person.origin
    betas = torch.from_numpy(person.betas).expand(frames, -1).clone()
    body = vectors[:, 1:].reshape(frames, -1)
    return BodyPose(
        "makehuman", "neutral", betas, vectors[:, 0], body, torch.from_numpy(transl), {}
    )


def world_turns(skeleton: Skeleton, motion: Motion) -> dict[str, Float[np.ndarray, "frames 3 3"]]:
    """How each of the actor's bones is turned from the rest pose."""
    turns: dict[str, np.ndarray] = {}
    for name, bone in skeleton.items():
        own = bone.axes @ euler(motion.angles[name]) @ bone.axes.T
        turns[name] = turns[bone.parent] @ own if bone.parent else own
    return turns


def _rest(person: Person, skeleton: Skeleton) -> dict[str, Float[np.ndarray, "3 3"]]:
    """Turns that bring the open body from its T-pose to the actor's rest pose, by joint."""
    out: dict[str, np.ndarray] = {}
    for name, bone in ACTOR.items():
        side, _, joint = name.partition("_")
        if joint in ENDS:
            own = person.joints[AT[f"{side}_{ENDS[joint]}"]] - person.joints[AT[name]]
            out[name] = swing(own, skeleton[bone].direction)
        elif joint in ("ankle", "foot"):
            out[name] = swing(-Y, skeleton[f"{side[0]}tibia"].direction)
        elif joint == "wrist":
            out[name] = out[f"{side}_elbow"]
        else:
            out[name] = np.eye(3)
    return out


def swing(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation between two directions that are not opposite."""
    a, b = unit(start), unit(end)
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis), float(a @ b))
    return from_vector(unit(axis) * angle)
