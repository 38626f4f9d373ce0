"""2D joints: what detectors write, with tracks, and the file keypoints.npz.

Lists of instances are COCO's results, AlphaPose's (Halpe) and MMPose's; arrays are rtmlib's.
OpenPose writes a file an image, with the body (BODY_25), and hands and face where detected.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.bodies.keypoints import LAYOUTS as JOINTS
from mover.core.errors import InputError
from mover.core.types import Keypoints
from mover.io.files.fields import (
    LARGEST,
    At,
    array,
    choice,
    get,
    items,
    mapping,
    maybe,
    read_json,
    refuse,
)
from mover.io.files.npz import read_npz, write_npz
from mover.io.formats import chosen
from mover.io.people.found import Known, followed
from mover.io.people.values import (
    either,
    files_of,
    need,
    number_in,
    numbers,
    read_any,
    rows,
    whole,
)

LAYOUTS = {name: len(JOINTS[name]) for name in ("openpose25", "openpose137", "coco17", "halpe26")}
"""Number of joints of each layout."""
CENTRE = 0.5  # [px], detectors call the centre of the top-left pixel (0, 0)
JSON_LIMIT = "a list of instances, or an object with 'annotations' or 'instance_info'"
PARTS = {
    "pose_keypoints_2d": 25,
    "hand_left_keypoints_2d": 21,
    "hand_right_keypoints_2d": 21,
    "face_keypoints_2d": 70,
}
"""Triples of a person of OpenPose."""


def keypoints_from(tool: str, path: Path, known: Known | None = None) -> Keypoints:
    """Keypoints that a detector found."""
    return chosen("tool", tool, "keypoints")(Path(path), known or Known())


@dataclass(frozen=True)
class PersonJoints:
    """The joints of one person in one image, as a file has them."""

    frame: int
    person: int
    """Its track; negative: unknown."""
    joints: NDArray[np.float64]
    """(joints, 3): x, y [px], confidence."""


def keypoints_of(
    seen: Sequence[PersonJoints], layout: str, fps: float | None, file: str
) -> Keypoints:
    """Keypoints with tracks; people without any joint are left out.

    People are followed from image to image where the file has no tracks.

    Raises:
        InputError: If no person is left, or a frame is negative.
    """
    kept = [s for s in map(_clean, seen) if s.joints[:, 2].any()]
    if not kept:
        raise InputError(f"{file}: has no joints of anyone, expected at least one person")
    frame = np.array([s.frame for s in kept])
    if frame.min() < 0:
        raise InputError(f"{file}: frames are numbered from {frame.min()}, expected from 0")
    person = np.array([s.person for s in kept])
    pairs = {(s.frame, s.person) for s in kept}
    if person.min() < 0 or len(pairs) < len(kept):
        points = [s.joints[s.joints[:, 2] > 0, :2] for s in kept]
        low, high = np.array([p.min(0) for p in points]), np.array([p.max(0) for p in points])
        size = np.linalg.norm(high - low, axis=1)
        person = followed(frame.tolist(), (low + high) / 2, size)
    order = np.lexsort((person, frame))
    joints = torch.from_numpy(np.stack([kept[i].joints for i in order]).astype(np.float32))
    return Keypoints(
        points=joints[..., :2].contiguous(),
        confidence=joints[..., 2].contiguous(),
        layout=layout,
        frame=torch.from_numpy(frame[order].astype(np.int64)),
        person=torch.from_numpy(person[order].astype(np.int64)),
        fps=fps,
    )


def _clean(seen: PersonJoints) -> PersonJoints:
    """Pixels as the package counts them; confidence from 0 to 1, 0 where a joint is missing."""
    finite = (np.abs(seen.joints) <= LARGEST).all(1, keepdims=True)  # false for NaN as well
    joints = np.where(finite, seen.joints, 0.0)
    sure = np.clip(joints[:, 2], 0, 1)
    points = (joints[:, :2] + CENTRE) * (sure > 0)[:, None]
    return PersonJoints(seen.frame, seen.person, np.concatenate([points, sure[:, None]], 1))


def read_instances(path: Path, known: Known, layout: str) -> Keypoints:
    """Keypoints of a JSON file or of arrays (.npz: keypoints, scores, frame, person)."""
    at = read_any(path)
    count = LAYOUTS[layout]
    if path.suffix.lower() == ".npz":
        seen = _arrays(at, count)
    else:
        seen = [_instance(one, frame, count) for one, frame in _listed(at)]
    moved = [PersonJoints(s.frame - known.first, s.person, s.joints) for s in seen]
    return keypoints_of(moved, layout, known.fps, path.name)


def _listed(at: At) -> list[tuple[At, int]]:
    """Instances with their frames."""
    if isinstance(at.value, list):
        return [(one, _frame(one)) for one in items(at)]
    if not isinstance(at.value, dict):
        refuse(at, JSON_LIMIT)
    images = either(at, "instance_info")
    if images is not None:
        found: list[tuple[At, int]] = []
        for index, image in enumerate(items(images)):
            number = either(image, "frame_id", "image_id")
            frame = index if number is None else _integer(number)
            found += [(one, frame) for one in items(need(image, "instances"))]
        return found
    return [(one, _frame(one)) for one in items(need(at, "annotations", "instance_info"))]


def _frame(at: At) -> int:
    """The image of an instance: a number, or a file name with one."""
    return _integer(need(at, "image_id", "frame_id", "frame"))


def _integer(at: At) -> int:
    """A whole number, or the last number in a name."""
    found = re.findall(r"\d+", Path(str(at.value)).stem)
    if isinstance(at.value, bool) or not found:
        refuse(at, "a number, or a name with one")
    return int(found[-1])


def _instance(at: At, frame: int, count: int) -> PersonJoints:
    given = need(at, "keypoints")
    scores = either(at, "keypoint_scores", "scores")
    joints = _joints(given, None if scores is None else numbers(scores), count)
    track = either(at, "track_id", "idx", "person_id")
    marked = "num_keypoints" in mapping(at)  # ground truth: 0 absent, 1 hidden, 2 visible
    if marked:
        joints[:, 2] = joints[:, 2] > 0
    return PersonJoints(frame, -1 if track is None else _track(track), joints)


def _track(at: At) -> int:
    """A track as a number; -1 where it is written in another way."""
    given: Any = at.value
    while isinstance(given, list) and len(given) == 1:
        given = given[0]
    if isinstance(given, bool) or not isinstance(given, int | float) or not given >= 0:
        return -1
    return int(given)


def _joints(at: At, scores: NDArray[np.float64] | None, count: int) -> NDArray[np.float64]:
    value = numbers(at)
    width = value.size // count if value.size % count == 0 else 0
    if width not in (2, 3) or (value.ndim > 1 and value.shape[-1] != width):
        refuse(at, f"{count} joints of 2 or 3 numbers", f"shape {value.shape}")
    if width == 3:
        return value.reshape(count, 3).copy()
    if scores is None or scores.size != count:
        refuse(at, f"{count} joints with 'keypoint_scores'", "points without confidences")
    return np.concatenate([value.reshape(count, 2), scores.reshape(count, 1)], 1)


def _arrays(at: At, count: int) -> list[PersonJoints]:
    given, scores = need(at, "keypoints", "points"), either(at, "scores", "confidence")
    frames = whole(need(at, "frame", "frames"))
    person = either(at, "person", "track_id")
    who = np.full(len(frames), -1) if person is None else whole(person)
    points = rows(given, len(frames))
    if len(who) != len(frames):
        refuse(given, "as many rows as frames", f"{len(frames)} frames and {len(who)} tracks")
    sure = None if scores is None else rows(scores, len(frames), count)
    return [
        PersonJoints(
            int(frame),
            int(track),
            _joints(At(points[k], at.file, given.field), None if sure is None else sure[k], count),
        )
        for k, (frame, track) in enumerate(zip(frames, who, strict=True))
    ]


def read_openpose(path: Path, known: Known) -> Keypoints:
    """Keypoints of a folder of OpenPose JSON, or of one file."""
    files = files_of(path, "*.json", "OpenPose's keypoints")
    seen: list[PersonJoints] = []
    for index, file in enumerate(files):
        name = file.stem.removesuffix("_keypoints")
        frame = number_in(name, index) - known.first if path.is_dir() else 0
        at = read_json(file)
        seen += [_of_openpose(person, frame) for person in items(need(at, "people"))]
    more = any(s.joints[25:, 2].any() for s in seen)
    if not more:
        seen = [PersonJoints(s.frame, s.person, s.joints[:25]) for s in seen]
    return keypoints_of(seen, "openpose137" if more else "openpose25", known.fps, path.name)


def _of_openpose(at: At, frame: int) -> PersonJoints:
    need(at, "pose_keypoints_2d")
    joints = np.concatenate([_part(at, name, count) for name, count in PARTS.items()])
    given = either(at, "person_id")
    ids = [-1.0] if given is None else numbers(given).reshape(-1).tolist() or [-1.0]
    return PersonJoints(frame, int(ids[0]), joints)


def _part(at: At, name: str, count: int) -> NDArray[np.float64]:
    """The triples of a part; zeros where it is not given."""
    given = either(at, name)
    if given is None or not np.size(numbers(given)):
        return np.zeros((count, 3))
    value = numbers(given)
    if value.size != count * 3:
        refuse(given, f"{count} triples x, y, confidence", f"{value.size} numbers")
    return value.reshape(count, 3)


# keypoints.npz.


def write_keypoints(keypoints: Keypoints, path: Path) -> None:
    """Write keypoints as they are."""
    arrays: dict[str, NDArray[Any]] = {
        "layout": np.array(keypoints.layout),
        "frame": keypoints.frame.cpu().numpy(),
        "person": keypoints.person.cpu().numpy(),
        "points": keypoints.points.detach().cpu().numpy(),
        "confidence": keypoints.confidence.detach().cpu().numpy(),
    }
    if keypoints.fps is not None:
        arrays["fps"] = np.array(keypoints.fps)
    write_npz(arrays, path)


def read_keypoints(path: Path) -> Keypoints:
    """Read and check keypoints.npz."""
    at = read_npz(path)
    word = get(at, "layout")
    layout = choice(At(str(array(word, (), "text")), at.file, "layout"), tuple(LAYOUTS))
    frame = array(get(at, "frame"), ("B",), "whole").astype(np.int64)
    rows = len(frame)
    person = array(get(at, "person"), (rows,), "whole").astype(np.int64)
    if not rows or frame.min() < 0 or person.min() < 0:
        refuse(get(at, "frame"), "rows with frames and tracks from 0")
    points = array(get(at, "points"), (rows, LAYOUTS[layout], 2)).astype(np.float32)
    sure = get(at, "confidence")
    confidence = array(sure, (rows, LAYOUTS[layout])).astype(np.float32)
    if confidence.min() < 0 or confidence.max() > 1:
        refuse(sure, "numbers from 0 to 1", f"{confidence.min():g} to {confidence.max():g}")
    fps = maybe(at, "fps")
    return Keypoints(
        points=torch.from_numpy(points),
        confidence=torch.from_numpy(confidence),
        layout=layout,
        frame=torch.from_numpy(frame),
        person=torch.from_numpy(person),
        fps=None if fps is None else float(array(fps, ())[()]),
    )
