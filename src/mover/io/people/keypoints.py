"""Keypoints of detectors: their layouts, tracks, and the file keypoints.npz."""

import dataclasses
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
from mover.io.files.fields import LARGEST, At, array, choice, get, maybe, refuse
from mover.io.files.npz import read_npz, write_npz
from mover.io.formats import chosen
from mover.io.people.found import Known, followed

LAYOUTS = {name: len(JOINTS[name]) for name in
           ("openpose25", "openpose137", "coco17", "halpe26", "wholebody133")}  # fmt: skip
"""Number of joints of each layout."""

LEFT_HAND, RIGHT_HAND, FACE = 25, 46, 67
"""Where the parts of `openpose137` start."""

_COCO = {0: 0, 2: 6, 3: 8, 4: 10, 5: 5, 6: 7, 7: 9, 9: 12, 10: 14, 11: 16, 12: 11, 13: 13, 14: 15,
         15: 2, 16: 1, 17: 4, 18: 3}  # fmt: skip
_HALPE_FEET = {19: 20, 20: 22, 21: 24, 22: 21, 23: 23, 24: 25}
_WHOLE_FEET = {19: 17, 20: 18, 21: 19, 22: 20, 23: 21, 24: 22}
_HANDS = {LEFT_HAND + k: 91 + k for k in range(42)}
_FACE = {FACE + k: 23 + k for k in range(68)}
_MIDDLES = {1: (5, 6), 8: (11, 12)}

SOURCES = {
    "openpose25": {k: k for k in range(25)},
    "openpose137": {k: k for k in range(137)},
    "coco17": _COCO,
    "halpe26": {**_COCO, **_HALPE_FEET, 1: 18, 8: 19},
    "wholebody133": {**_COCO, **_WHOLE_FEET, **_HANDS, **_FACE},
}
"""For each joint of `openpose137` that a layout has, its index there."""


def as_openpose(keypoints: Keypoints) -> Keypoints:
    """The same keypoints as OpenPose's 25 + 21 + 21 + 70; what the detector lacks is missing.

    COCO has no neck and no middle of the hips: they are the middles of the shoulders and hips, as
    sure as the less sure of the two.
    """
    table = SOURCES[keypoints.layout]
    count = LAYOUTS["openpose137"]
    rows = len(keypoints.frame)
    points = keypoints.points.new_zeros(rows, count, 2)
    confidence = keypoints.confidence.new_zeros(rows, count)
    there, here = list(table), list(table.values())
    points[:, there] = keypoints.points[:, here]
    confidence[:, there] = keypoints.confidence[:, here]
    for joint, (a, b) in _MIDDLES.items():
        if joint in table:
            continue
        points[:, joint] = (keypoints.points[:, a] + keypoints.points[:, b]) / 2
        confidence[:, joint] = torch.minimum(keypoints.confidence[:, a], keypoints.confidence[:, b])
    points = points * (confidence > 0)[..., None]
    return dataclasses.replace(
        keypoints, points=points, confidence=confidence, layout="openpose137"
    )


# From lists of joints by image to tracks of keypoints.


CENTRE = 0.5  # [px], detectors call the centre of the top-left pixel (0, 0)


@dataclass(frozen=True)
class Seen:
    """The joints of one person in one image, as a file has them."""

    frame: int
    person: int
    """Its track; negative: not told."""
    joints: NDArray[np.float64]
    """(joints, 3): x, y [px], confidence."""


def keypoints_of(seen: Sequence[Seen], layout: str, fps: float | None, file: str) -> Keypoints:
    """Keypoints with tracks; people without any joint are left out.

    People are followed from image to image where the file does not tell who is who.

    Raises:
        InputError: If nobody is left, or a frame is negative.
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
        boxes = np.array([_box(s.joints) for s in kept])
        size = np.linalg.norm(boxes[:, 2:] - boxes[:, :2], axis=1)
        person = followed(frame.tolist(), (boxes[:, :2] + boxes[:, 2:]) / 2, size)
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


def _clean(seen: Seen) -> Seen:
    """Pixels as the package counts them; confidence from 0 to 1, 0 where a joint is missing."""
    told = (np.abs(seen.joints) <= LARGEST).all(1, keepdims=True)  # false for NaN as well
    joints = np.where(told, seen.joints, 0.0)
    sure = np.clip(joints[:, 2], 0, 1)
    points = (joints[:, :2] + CENTRE) * (sure > 0)[:, None]
    return Seen(seen.frame, seen.person, np.concatenate([points, sure[:, None]], 1))


def _box(joints: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where the joints lie: the low and the high corner [px]."""
    points = joints[joints[:, 2] > 0, :2]
    return np.concatenate([points.min(0), points.max(0)])


# keypoints.npz: the joints that a detector saw, by frame and person.


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


def keypoints_from(tool: str, path: Path, known: Known | None = None) -> Keypoints:
    """Keypoints that a detector found.

    Raises:
        InputError: If the detector is not known, or its files are not as it writes them.
    """
    return chosen("tool", tool, "keypoints")(Path(path), known or Known())
