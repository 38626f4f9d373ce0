"""Motion capture on the open body: bones point where the actor's bones point.

Acclaim's two files are text, a skeleton (.asf) and its motion (.amc); the free library of Carnegie
Mellon University (mocap.cs.cmu.edu) is written in them. Only files that the user has are read; none
comes with this package.
"""

import dataclasses
from pathlib import Path
from typing import NoReturn

import numpy as np
import torch
from jaxtyping import Float

from mover.bodies.skeleton import PARENTS
from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.core.records import map_tensors, record
from mover.core.types import Bodies, BodyPose
from mover_bench.rooms.known import rounded
from mover_bench.rooms.poses import AT, Person, make_person
from mover_bench.rooms.turns import X, Y, Z, about, from_vector, to_vector, unit

AXES = {"rx": 0, "ry": 1, "rz": 2}
ROOT = "root"
ROOT_ORDER = ("tx", "ty", "tz", "rx", "ry", "rz")


@record
class Bone:
    """One bone of an Acclaim skeleton."""

    parent: str
    """Name of the bone that carries it; the root has none (empty)."""
    direction: Float[np.ndarray, "3"]
    """In the rest pose, a unit vector; zero for the root."""
    length: float
    """In the units of the file."""
    axes: Float[np.ndarray, "3 3"]
    """Rotation of the axes that the joint turns about."""
    freedom: tuple[int, ...]
    """The axes of its angles, in the order of the motion file."""


Skeleton = dict[str, Bone]
"""Bones by name, parents before children; begins with the root."""


@record
class Motion:
    """A clip."""

    place: Float[np.ndarray, "frames 3"]
    """Of the root, in the units of the skeleton."""
    angles: dict[str, Float[np.ndarray, "frames 3"]]
    """About the three axes of each bone [rad]."""


def euler(angles: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """Rotations about the fixed axes x, then y, then z [rad]."""
    return about(Z, angles[..., 2]) @ about(Y, angles[..., 1]) @ about(X, angles[..., 0])


def read_skeleton(path: Path) -> Skeleton:
    """Read an .asf file.

    Raises:
        InputError: If it is no such file, or angles are not in degrees.
    """
    lines = _lines(path)
    blank = np.zeros(3)
    root = Bone("", blank, 0.0, np.eye(3), (0, 1, 2))
    bones, parents = {ROOT: root}, dict[str, str]()
    section, fields = "", dict[str, tuple[int, list[str]]]()
    for number, words in lines:
        if words[0].startswith(":"):
            section = words[0]
        elif section == ":units" and words[0] == "angle" and words[1:] != ["deg"]:
            _refuse(path, number, words, "angle deg")
        elif section == ":root" and words[0] in ("order", "position", "orientation"):
            _check_root(path, number, words)
        elif section == ":bonedata" and words[0] == "end":
            name, bone = _bone(path, (number, words), fields)
            bones[name], fields = bone, {}
        elif section == ":bonedata":
            fields[words[0]] = number, words[1:]
        elif section == ":hierarchy" and words[0] not in ("begin", "end"):
            parents |= dict.fromkeys(words[1:], words[0])
    return _ordered(path, bones, parents)


def _check_root(path: Path, number: int, words: list[str]) -> None:
    if words[0] == "order":
        if tuple(w.lower() for w in words[1:]) != ROOT_ORDER:
            _refuse(path, number, words, "order TX TY TZ RX RY RZ")
    elif _numbers(path, (number, words), 3).any():
        _refuse(path, number, words, f"{words[0]} 0 0 0")


def _bone(
    path: Path, end: tuple[int, list[str]], fields: dict[str, tuple[int, list[str]]]
) -> tuple[str, Bone]:
    for field in ("name", "direction", "length", "axis"):
        if field not in fields or not fields[field][1]:
            _refuse(path, *end, f"a bone with {field}")
    row = {k: (n, [k, *w]) for k, (n, w) in fields.items()}
    number, axis = fields["axis"]
    if axis[3:] != ["XYZ"]:
        _refuse(path, number, axis, "three angles and XYZ")
    direction = _numbers(path, row["direction"], 3)
    if not 0.5 < np.linalg.norm(direction) < 2:
        _refuse(path, *row["direction"], "a unit vector")
    number, freedom = fields.get("dof", (0, []))
    if not all(f.lower() in AXES for f in freedom):
        _refuse(path, number, freedom, "dof of rx, ry, rz")
    axes = euler(np.radians(_numbers(path, (number, ["axis", *axis[:3]]), 3)))
    length = float(_numbers(path, row["length"], 1)[0])
    direction = direction / np.linalg.norm(direction)
    turns = tuple(AXES[f.lower()] for f in freedom)
    return fields["name"][1][0], Bone("", direction, length, axes, turns)


def _ordered(path: Path, bones: Skeleton, parents: dict[str, str]) -> Skeleton:
    """Parents before children."""
    done: Skeleton = {ROOT: bones[ROOT]}
    while len(done) < len(bones):
        ready = [n for n in bones if n not in done and parents.get(n) in done]
        if not ready:
            lost = ", ".join(n for n in bones if n not in done)
            raise InputError(f"{path.name}: no way from the root to {lost}, expected a hierarchy")
        for name in ready:
            bone = bones[name]
            done[name] = Bone(parents[name], bone.direction, bone.length, bone.axes, bone.freedom)
    return done


def read_motion(path: Path, skeleton: Skeleton) -> Motion:
    """Read an .amc file.

    Raises:
        InputError: If it is no such file, or does not belong to the skeleton.
    """
    frames = _frames(path, skeleton)
    moving = [n for n, b in skeleton.items() if b.freedom]
    for index, frame in enumerate(frames):
        if lost := [n for n in moving if n not in frame]:
            raise InputError(f"{path.name}: frame {index + 1} lacks {lost[0]}, expected its angles")
    if not frames:
        raise InputError(f"{path.name}: has no frames, expected at least one")
    angles = {n: np.zeros((len(frames), 3)) for n in skeleton}
    for name in moving:
        rows = np.stack([f[name] for f in frames])[:, 3 * (name == ROOT) :]
        angles[name][:, skeleton[name].freedom] = np.radians(rows)
    return Motion(np.stack([f[ROOT][:3] for f in frames]), angles)


def _frames(path: Path, skeleton: Skeleton) -> list[dict[str, np.ndarray]]:
    """The numbers of each bone in each frame."""
    frames: list[dict[str, np.ndarray]] = []
    for number, words in _lines(path):
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif words[0].startswith(":"):
            if words[0].upper() == ":RADIANS":
                _refuse(path, number, words, ":DEGREES")
        elif not frames or words[0] not in skeleton:
            _refuse(path, number, words, "a frame's number or a bone of the skeleton")
        else:
            count = len(skeleton[words[0]].freedom) + 3 * (words[0] == ROOT)
            frames[-1][words[0]] = _numbers(path, (number, words), count)
    return frames


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Number and words of each line that is neither empty nor a comment."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    rows = [(k + 1, line.split()) for k, line in enumerate(text.splitlines())]
    return [(k, words) for k, words in rows if words and not words[0].startswith("#")]


def _numbers(path: Path, line: tuple[int, list[str]], count: int) -> Float[np.ndarray, " count"]:
    number, words = line
    try:
        values = np.array([float(w) for w in words[1:]])
    except ValueError:
        _refuse(path, number, words, "numbers")
    if len(values) != count or not np.isfinite(values).all():
        _refuse(path, number, words, f"{count} numbers")
    return values


def _refuse(path: Path, number: int, words: list[str], expected: str) -> NoReturn:
    line = " ".join(words)[:60]
    raise InputError(f"{path.name}: line {number} has {line!r}, expected {expected}")


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
