"""Bring a body into touch: move it until it presses a few millimetres into what carries it."""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from ..bodies import open_body
from .person import AT, Person
from .placed import Placed, distances
from .poses import Posture, moved, skinned

PRESS = 0.006  # [m], how deep skin gives way
GROUPS: dict[str, tuple[str, ...]] = {
    "lower": ("pelvis", "left_hip", "right_hip", "left_knee", "right_knee"),
    "trunk": ("spine1", "spine2", "spine3", "left_collar", "right_collar"),
    "head": ("neck", "head"),
    "left_hand": ("left_wrist",),
    "right_hand": ("right_wrist",),
    "core": ("pelvis", "left_hip", "right_hip", "spine1", "spine2", "spine3"),
    "torso": (
        "pelvis", "left_hip", "right_hip", "spine1", "spine2", "spine3", "left_collar",
        "right_collar",
    ),
    "feet": ("left_ankle", "right_ankle", "left_foot", "right_foot"),
}  # fmt: skip
"""Parts of the body by the joints that move them."""


@cache
def part(name: str) -> Bool[np.ndarray, " verts"]:
    """The vertices of one of `GROUPS`, or of all of them."""
    model = open_body()
    joint = model.weights.argmax(1).numpy()
    if name == "all":
        return np.ones(len(joint), dtype=bool)
    wanted = [AT[j] for j in GROUPS[name]]
    if name.endswith("_hand"):
        side = name.removesuffix("_hand")
        wanted += [k for k, n in enumerate(model.joint_names) if k > 24 and n.startswith(side)]
    return np.isin(joint, wanted)


def part_of(vertex: int) -> str:
    """Name of the joint that moves a vertex most."""
    model = open_body()
    return model.joint_names[int(model.weights[vertex].argmax())]


def gap(person: Person, posture: Posture, piece: Placed, group: str) -> float:
    """Distance from a part of the body (one frame) to a piece; negative: inside [m]."""
    return float(distances(piece, skinned(person, posture, part(group))[0], 0.6).min())


def approach(distance: Callable[[float], float], start: float, speed: float, most: float) -> float:
    """The first value after `start` at which the distance has shrunk to `-PRESS`.

    Args:
        distance: Of a part of the body to a piece, for a value (a height, an angle) [m].
        start: A value without touch.
        speed: No point of the part moves farther than this for one unit of the value; its sign
            is that of the way to go.
        most: Where to give up, as a change of the value.
    """
    value = start
    for _ in range(25):
        left = distance(value) + PRESS
        if left < 2e-4 or abs(value - start) >= abs(most):
            break
        value += left / speed
    return value


def rest_on(
    person: Person, posture: Posture, piece: Placed, group: str
) -> Float[np.ndarray, " frames"]:
    """For each frame, how far the whole body must rise to lie on a piece [m]."""
    skin = skinned(person, posture, part(group))
    rise = np.zeros(len(skin))
    for k, points in enumerate(skin):

        def above(height: float, points: np.ndarray = points) -> float:
            return float(distances(piece, points + np.array([0, height, 0]), 0.6).min())

        rise[k] = approach(above, 0.3, -1.0, 0.9)
    return rise


def laid(person: Person, posture: Posture, piece: Placed, group: str) -> Posture:
    """The whole body lowered or lifted, frame by frame, until a part of it lies on a piece."""
    rise = rest_on(person, posture, piece, group)
    return moved(posture, rise[:, None] * np.array([0.0, 1.0, 0.0]))
