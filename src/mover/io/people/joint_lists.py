"""Keypoints in lists of instances: COCO results, AlphaPose (Halpe), MMPose, and rtmlib's arrays."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.types import Keypoints
from mover.io.files.fields import At, items, mapping, refuse
from mover.io.people.found import Known
from mover.io.people.keypoints import LAYOUTS, Seen, keypoints_of
from mover.io.people.values import either, need, numbers, read_any, rows, whole, wide

JSON_LIMIT = "a list of instances, or an object with 'annotations' or 'instance_info'"


def read_instances(path: Path, known: Known, layout: str) -> Keypoints:
    """Keypoints of a JSON file or of arrays (.npz: keypoints, scores, frame, person).

    Raises:
        InputError: If it is none of these, or has another number of joints.
    """
    at = read_any(path)
    count = LAYOUTS[layout]
    if path.suffix.lower() == ".npz":
        seen = _arrays(at, count)
    else:
        seen = [_instance(one, frame, count) for one, frame in _listed(at)]
    moved = [Seen(s.frame - known.first, s.person, s.joints) for s in seen]
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


def _instance(at: At, frame: int, count: int) -> Seen:
    """One person of one image."""
    given = need(at, "keypoints")
    scores = either(at, "keypoint_scores", "scores")
    joints = _joints(given, None if scores is None else numbers(scores), count)
    track = either(at, "track_id", "idx", "person_id")
    marked = "num_keypoints" in mapping(at)  # ground truth: 0 absent, 1 hidden, 2 visible
    if marked:
        joints[:, 2] = joints[:, 2] > 0
    return Seen(frame, -1 if track is None else _track(track), joints)


def _track(at: At) -> int:
    """A track as a number; -1 where it is told in another way."""
    given: Any = at.value
    while isinstance(given, list) and len(given) == 1:
        given = given[0]
    if isinstance(given, bool) or not isinstance(given, int | float) or not given >= 0:
        return -1
    return int(given)


def _joints(at: At, scores: NDArray[np.float64] | None, count: int) -> NDArray[np.float64]:
    """Points and confidences of one person."""
    value = numbers(at)
    width = value.size // count if value.size % count == 0 else 0
    if width not in (2, 3) or (value.ndim > 1 and value.shape[-1] != width):
        refuse(at, f"{count} joints of 2 or 3 numbers", f"shape {value.shape}")
    if width == 3:
        return value.reshape(count, 3).copy()
    if scores is None or scores.size != count:
        refuse(at, f"{count} joints with 'keypoint_scores'", "points without confidences")
    return np.concatenate([value.reshape(count, 2), scores.reshape(count, 1)], 1)


def _arrays(at: At, count: int) -> list[Seen]:
    """Rows of arrays."""
    given, scores = need(at, "keypoints", "points"), either(at, "scores", "confidence")
    frames = whole(need(at, "frame", "frames"))
    person = either(at, "person", "track_id")
    who = np.full(len(frames), -1) if person is None else whole(person)
    points = wide(given, len(frames))
    if len(who) != len(frames):
        refuse(given, "as many rows as frames", f"{len(frames)} frames and {len(who)} tracks")
    sure = None if scores is None else rows(scores, len(frames), count)
    return [
        Seen(
            int(frame),
            int(track),
            _joints(At(points[k], at.file, given.field), None if sure is None else sure[k], count),
        )
        for k, (frame, track) in enumerate(zip(frames, who, strict=True))
    ]
