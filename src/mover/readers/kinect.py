"""People of Kinect's 25 joints, as capsules along the bones: a body that any mesh stage takes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .placing import Matrix

JOINTS = 25
NAMES = (
    "pelvis", "spine2", "neck", "head", "left_shoulder", "left_elbow", "left_wrist", "left_hand",
    "right_shoulder", "right_elbow", "right_wrist", "right_hand", "left_hip", "left_knee",
    "left_ankle", "left_foot", "right_hip", "right_knee", "right_ankle", "right_foot", "spine3",
    "left_index3", "left_thumb3", "right_index3", "right_thumb3",
)  # fmt: skip
"""Kinect's joints under the names of SMPL-X, where it has them."""
BONES = (
    (0, 1, 0.13), (1, 20, 0.13), (20, 2, 0.07), (2, 3, 0.09), (20, 4, 0.07), (4, 5, 0.045),
    (5, 6, 0.035), (6, 7, 0.035), (20, 8, 0.07), (8, 9, 0.045), (9, 10, 0.035), (10, 11, 0.035),
    (0, 12, 0.11), (12, 13, 0.075), (13, 14, 0.05), (14, 15, 0.035), (0, 16, 0.11),
    (16, 17, 0.075), (17, 18, 0.05), (18, 19, 0.035),
)  # fmt: skip
"""Two joints and the thickness of the limb between them [m]."""
SIDES, RINGS = 12, 4
SHORTEST = 0.01  # [m], joints that lie on each other have no direction


def capsule_people(
    skeletons: Sequence[tuple[int, int, Matrix]], turn: Matrix, fps: float
) -> dict[str, Any]:
    """The arrays of bodies.npz.

    Args:
        skeletons: Frame, person and joints (25, 3) in Kinect's camera space [m].
        turn: The camera's axes (x right, y down, z forward) from there (3, 3).
        fps: Frames a second.
    """
    joints = np.stack([joints @ turn.T for _, _, joints in skeletons])
    unit, faces = _unit_capsule()
    parts = [_limbs(joints[:, a], joints[:, b], radius, unit) for a, b, radius in BONES]
    triangles = np.concatenate([faces + i * len(unit) for i in range(len(BONES))])
    return {
        "vertices": np.concatenate(parts, axis=1).astype(np.float32),
        "faces": triangles,
        "joints": joints.astype(np.float32),
        "joint_names": np.array(NAMES),
        "frame": np.array([frame for frame, _, _ in skeletons]),
        "person": np.array([person for _, person, _ in skeletons]),
        "space": np.array("camera"),
        "fps": np.array(fps),
    }


def _unit_capsule() -> tuple[Matrix, NDArray[np.int64]]:
    """Points (x, y, end, bulge): a circle's place, which end, how far beyond it; and triangles."""
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    tilts = np.linspace(0, np.pi / 2, RINGS + 1)[:-1]
    rows: list[list[float]] = []
    rings = [(0.0, -t) for t in reversed(tilts)] + [(1.0, t) for t in tilts]
    for end, tilt in rings:
        c, s = np.cos(tilt), np.sin(tilt)
        rows += [[c * np.cos(a), c * np.sin(a), end, s] for a in angles.tolist()]
    poles = len(rows)
    rows += [[0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 1.0]]
    faces: list[tuple[int, int, int]] = []
    for ring in range(len(rings) - 1):
        for i in range(SIDES):
            a, b = ring * SIDES + i, ring * SIDES + (i + 1) % SIDES
            faces += [(a, b, b + SIDES), (a, b + SIDES, a + SIDES)]
    last = (len(rings) - 1) * SIDES
    for i in range(SIDES):
        j = (i + 1) % SIDES
        faces += [(j, i, poles), (last + i, last + j, poles + 1)]
    return np.array(rows), np.array(faces)


def _limbs(start: Matrix, end: Matrix, radius: float, unit: Matrix) -> Matrix:
    """Capsules (bodies, points, 3) between two joints of all bodies."""
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    w = np.where(length > SHORTEST, along / np.maximum(length, 1e-9), np.array([0.0, 1.0, 0.0]))
    helper = np.where(np.abs(w[:, 2:]) < 0.9, np.array([0.0, 0, 1.0]), np.array([1.0, 0, 0]))
    u = np.cross(helper, w)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(w, u)
    x, y, e, bulge = unit.T
    side = radius * (x[:, None] * u[:, None] + y[:, None] * v[:, None])
    axis = e[:, None] * along[:, None] + radius * bulge[:, None] * w[:, None]
    return start[:, None] + side + axis
