"""2D joints: what detectors write, with tracks, and the file keypoints.npz.

Lists of instances are COCO's results, AlphaPose's (Halpe), MMPose's and Ultralytics' (`to_json` of
each image in a list); easy_ViTPose has people by track in a list of images. OpenPose writes a file
an image, with the body (BODY_25), and hands and face where detected.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.bodies.keypoints import LAYOUTS as JOINTS
from mover.core.errors import InputError
from mover.core.types import Keypoints
from mover.io.capture.bodies_file import scalar
from mover.io.files.fields import FASTEST, LARGEST, SLOWEST, At, read_json, read_npz, write_npz
from mover.io.formats import chosen
from mover.io.people.found import Known, followed
from mover.io.people.values import files_of, frames_in, lone, named, need, numbers, tensor

_NAMES = ("openpose25", "openpose137", "coco17", "halpe26", "mediapipe33")
LAYOUTS = {name: len(JOINTS[name]) for name in _NAMES}
"""Number of joints of each layout."""
CENTRE = 0.5  # [px], detectors call the centre of the top-left pixel (0, 0)
PARTS = {
    "pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21,
    "face_keypoints_2d": 70,
}  # fmt: skip
"""Triples of a person of OpenPose."""


def keypoints_from(tool: str, path: Path, known: Known | None = None) -> Keypoints:
    """Keypoints that a detector found."""
    return chosen("tool", tool, "keypoints")(named(Path(path)), known or Known())


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

    Pixels are counted as the package does; confidence is 0 where a joint is missing. People are
    followed from image to image where the file has no tracks.

    Raises:
        InputError: If no person is left, or a frame is negative.
    """
    joints = np.stack([one.joints for one in seen]) if seen else np.zeros((0, 1, 3))
    finite = (np.abs(joints) <= LARGEST).all(2, keepdims=True)  # false for NaN as well
    joints = np.where(finite, joints, 0.0)
    sure = np.clip(joints[..., 2], 0, 1)
    kept = np.flatnonzero(sure.any(1))
    if not len(kept):
        raise InputError(f"{file}: has no joints of anyone, expected at least one person")
    sure, points = sure[kept], ((joints[..., :2] + CENTRE) * (sure > 0)[..., None])[kept]
    frame = np.array([seen[k].frame for k in kept.tolist()])
    person = np.array([seen[k].person for k in kept.tolist()])
    if frame.min() < 0:
        raise InputError(f"{file}: frames are numbered from {frame.min()}, expected from 0")
    if person.min() < 0 or len(np.unique(np.stack([frame, person]), axis=1).T) < len(kept):
        shown = np.where(sure[..., None] > 0, points, np.nan)
        low, high = np.nanmin(shown, 1), np.nanmax(shown, 1)
        size = np.linalg.norm(high - low, axis=1)
        person = followed(frame.tolist(), (low + high) / 2, size)
    order = np.lexsort((person, frame))
    return Keypoints(
        points=tensor(points[order]), confidence=tensor(sure[order]), layout=layout,
        frame=torch.from_numpy(frame[order].astype(np.int64)),
        person=torch.from_numpy(person[order].astype(np.int64)), fps=fps,
    )  # fmt: skip


def read_instances(path: Path, known: Known, layout: str) -> Keypoints:
    """Keypoints of a JSON file of instances."""
    at = read_json(path)
    if not isinstance(at.value, dict | list):
        at.refuse("a list of instances, or an object with 'annotations' or 'instance_info'")
    images = None if isinstance(at.value, list) else at.maybe("instance_info")
    if isinstance(at.value, list) and all(isinstance(image, list) for image in at.value):
        images = at.items()  # of Ultralytics: a list an image
        listed = [(one, at.holding(k)) for k, image in enumerate(images) for one in image.items()]
    elif isinstance(at.value, dict) and at.maybe("skeleton") is not None:
        listed = [
            (one, at.holding(k))
            for k, image in enumerate(need(at, "keypoints").items())
            for one in _of_vitpose(image)
        ]
    elif images is None:
        rows = at if isinstance(at.value, list) else need(at, "annotations", "instance_info")
        listed = [(one, need(one, "image_id", "frame_id", "frame")) for one in rows.items()]
    else:
        listed = [
            (one, image.maybe("frame_id", "image_id") or At(index, at.file))
            for index, image in enumerate(images.items())
            for one in need(image, "instances").items()
        ]
    seen: list[PersonJoints] = []
    for one, frame in listed:
        number = re.findall(r"\d+", Path(str(frame.value)).stem)
        if isinstance(frame.value, bool) or not number:
            frame.refuse("a number, or a name with one")
        seen.append(_instance(one, int(number[-1]) - known.first, LAYOUTS[layout]))
    return keypoints_of(seen, layout, known.fps, path.name)


def _of_vitpose(image: At) -> Iterator[At]:
    """People of an image of easy_ViTPose's --save-json: rows y, x, score by their track."""
    for track in image.mapping():
        joints = numbers(image.get(track))
        if joints.ndim != 2 or joints.shape[1] != 3 or not track.isdecimal():
            image.get(track).refuse("rows y, x, score by the number of a person")
        person = {"keypoints": joints[:, [1, 0, 2]].tolist(), "track_id": int(track)}
        yield image.holding(person)


def _instance(at: At, frame: int, count: int) -> PersonJoints:
    """One person of a list."""
    given, scores = need(at, "keypoints"), at.maybe("keypoint_scores", "scores")
    if isinstance(given.value, Mapping):  # Ultralytics
        axes = [numbers(need(given, axis)).reshape(-1) for axis in ("x", "y", "visible")]
        if {len(axis) for axis in axes} != {count}:
            given.refuse(f"{count} joints", f"{len(axes[0])}")
        value = np.stack(axes, -1)
    else:
        value = numbers(given)
    width = value.size // count if value.size % count == 0 else 0
    if width not in (2, 3) or (value.ndim > 1 and value.shape[-1] != width):
        given.refuse(f"{count} joints of 2 or 3 numbers", f"shape {value.shape}")
    joints = value.reshape(count, width)
    if width == 2:
        sure = None if scores is None else numbers(scores)
        if sure is None or sure.size != count:
            given.refuse(f"{count} joints with 'keypoint_scores'", "points without confidences")
        joints = np.concatenate([joints, sure.reshape(count, 1)], 1)
    if "num_keypoints" in at.mapping():  # ground truth: 0 absent, 1 hidden, 2 visible
        joints = np.where([True, True, False], joints, joints > 0)
    return PersonJoints(frame, _track(at), joints)


def _track(at: At) -> int:
    """The track of a person; what is no number from 0 is unknown, -1."""
    found = at.maybe("track_id", "idx", "person_id")
    track = -1 if found is None else lone(found)
    known = isinstance(track, int | float) and not isinstance(track, bool)
    return int(track) if known and 0 <= track <= LARGEST else -1


def read_openpose(path: Path, known: Known) -> Keypoints:
    """Keypoints of a folder of OpenPose JSON, or of one file."""
    files = files_of(path, "OpenPose's keypoints", "*.json")
    seen: list[PersonJoints] = []
    for file, frame in zip(files, frames_in(files, path, known), strict=True):
        for at in need(read_json(file), "people").items():
            need(at, "pose_keypoints_2d")
            joints: list[NDArray[np.float64]] = []
            for name, count in PARTS.items():
                value = numbers(at.maybe(name) or at.holding([]))
                if value.size not in (0, count * 3):
                    at.get(name).refuse(
                        f"{count} triples x, y, confidence", f"{value.size} numbers"
                    )
                joints.append(value.reshape(-1, 3) if value.size else np.zeros((count, 3)))
            seen.append(PersonJoints(frame, _track(at), np.concatenate(joints)))
    layout = "openpose137" if any(one.joints[25:, 2].any() for one in seen) else "openpose25"
    seen = [replace(one, joints=one.joints[: LAYOUTS[layout]]) for one in seen]
    return keypoints_of(seen, layout, known.fps, path.name)


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
    word = at.get("layout")
    layout = At(str(word.array((), "text")), at.file, "layout").choice(tuple(LAYOUTS))
    frame = torch.from_numpy(at.get("frame").indices("B"))
    if not (rows := len(frame)):
        at.get("frame").refuse("at least one row", "no rows")
    points = at.get("points").array((rows, LAYOUTS[layout], 2)).astype(np.float32)
    sure = at.get("confidence")
    confidence = sure.array((rows, LAYOUTS[layout])).astype(np.float32)
    if confidence.min() < 0 or confidence.max() > 1:
        sure.refuse("numbers from 0 to 1", f"{confidence.min():g} to {confidence.max():g}")
    return Keypoints(
        points=torch.from_numpy(points), confidence=torch.from_numpy(confidence), layout=layout,
        frame=frame, person=torch.from_numpy(at.get("person").indices(rows)),
        fps=scalar(at, "fps", SLOWEST, FASTEST),
    )  # fmt: skip
