"""OpenPose's JSON: a file an image, with the body (BODY_25), and hands and face where detected."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mover.core.types import Keypoints
from mover.io.files.fields import At, items, read_json, refuse
from mover.io.people.found import Known
from mover.io.people.keypoints import Seen, keypoints_of
from mover.io.people.values import either, files_of, need, number_in, numbers

PARTS = {
    "pose_keypoints_2d": 25,
    "hand_left_keypoints_2d": 21,
    "hand_right_keypoints_2d": 21,
    "face_keypoints_2d": 70,
}


def read_openpose(path: Path, known: Known) -> Keypoints:
    """Keypoints of a folder of OpenPose JSON, or of one file.

    Raises:
        InputError: If a file is not OpenPose's with BODY_25.
    """
    files = files_of(path, "*.json", "OpenPose's keypoints")
    seen: list[Seen] = []
    for index, file in enumerate(files):
        name = file.stem.removesuffix("_keypoints")
        frame = number_in(name, index) - known.first if path.is_dir() else 0
        at = read_json(file)
        seen += [_person(person, frame) for person in items(need(at, "people"))]
    more = any(s.joints[25:, 2].any() for s in seen)
    if not more:
        seen = [Seen(s.frame, s.person, s.joints[:25]) for s in seen]
    return keypoints_of(seen, "openpose137" if more else "openpose25", known.fps, path.name)


def _person(at: At, frame: int) -> Seen:
    need(at, "pose_keypoints_2d")
    joints = np.concatenate([_part(at, name, count) for name, count in PARTS.items()])
    given = either(at, "person_id")
    ids = [-1.0] if given is None else numbers(given).reshape(-1).tolist() or [-1.0]
    return Seen(frame, int(ids[0]), joints)


def _part(at: At, name: str, count: int) -> NDArray[np.float64]:
    """The triples of a part; zeros where it is not given."""
    given = either(at, name)
    if given is None or not np.size(numbers(given)):
        return np.zeros((count, 3))
    value = numbers(given)
    if value.size != count * 3:
        refuse(given, f"{count} triples x, y, confidence", f"{value.size} numbers")
    return value.reshape(count, 3)
