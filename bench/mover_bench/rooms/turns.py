"""Rotations of many frames in float64: about axes, from frames of axes, half-way, as vectors."""

import numpy as np
from jaxtyping import Float

Turns = Float[np.ndarray, "... 3 3"]
Vectors = Float[np.ndarray, "... 3"]
Angles = Float[np.ndarray, "..."]

X, Y, Z = np.eye(3)


def about(axis: Float[np.ndarray, "3"], angle: Angles) -> Turns:
    """Right-handed rotations about one of the unit axes; `angle` in [rad]."""
    return from_vector(np.asarray(angle)[..., None] * axis)


def from_vector(vector: Vectors) -> Turns:
    """Rotation matrices of axis-angle vectors [rad]."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    x, y, z = np.moveaxis(vector / np.maximum(angle, 1e-12), -1, 0)
    o = np.zeros_like(x)
    skew = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    angle = angle[..., None]
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def to_vector(turn: Turns) -> Vectors:
    """Axis-angle vectors [rad] of rotation matrices, angles in [0, pi]."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(turn.shape[:-1])


def between(start: Turns, end: Turns, share: Angles) -> Turns:
    """The shortest way from `start` (share 0) to `end` (share 1)."""
    step = to_vector(np.swapaxes(start, -1, -2) @ end)
    return start @ from_vector(np.asarray(share)[..., None] * step)


def unit(vector: Vectors) -> Vectors:
    """Vectors of length one."""
    return vector / np.maximum(np.linalg.norm(vector, axis=-1, keepdims=True), 1e-12)


def frame(first: Vectors, second: Vectors) -> Turns:
    """Right-handed axes: `first`, the part of `second` square to it, and their product."""
    a = unit(first)
    b = unit(second - (second * a).sum(-1, keepdims=True) * a)
    return np.stack([a, b, np.cross(a, b)], -1)


def apply(turn: Turns, vector: Vectors) -> Vectors:
    """Rotated vectors."""
    return (turn @ vector[..., None])[..., 0]


def smooth(share: Angles) -> Angles:
    """Ease in and out: 0 to 1 with no speed and no acceleration at both ends."""
    s = np.clip(share, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def heading_of(direction: Float[np.ndarray, "... 2"]) -> Float[np.ndarray, "..."]:
    """Angle about +y that turns +z into a direction on the floor (x, z) [rad]."""
    return np.asarray(np.arctan2(direction[..., 0], direction[..., 1]))


def facing(heading: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 2"]:
    """Direction on the floor (x, z) of a heading."""
    return np.stack([np.sin(heading), np.cos(heading)], -1)


def left_of(heading: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 2"]:
    """Direction on the floor (x, z) to the left of a heading."""
    return np.stack([np.cos(heading), -np.sin(heading)], -1)
