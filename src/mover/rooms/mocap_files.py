"""Read motion capture in Acclaim's two files: a skeleton (.asf) and its motion (.amc).

Both are text; the free library of Carnegie Mellon University (mocap.cs.cmu.edu) is written in them.
"""

from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from ..records import InputError, record
from .turns import X, Y, Z, about

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
