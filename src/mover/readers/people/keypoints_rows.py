"""From lists of joints by image to tracks of keypoints."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...records import InputError
from ...types import Keypoints
from ..fields import LARGEST
from .tracks import followed

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
