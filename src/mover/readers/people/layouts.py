"""Layouts of keypoints: the joints that each detector names, and all of them as OpenPose's."""

import dataclasses

import torch

from ...bodies.keypoints import LAYOUTS as JOINTS
from ...types import Keypoints

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
