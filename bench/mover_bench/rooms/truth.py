"""Whether bodies and furniture are true: touched where they should, sunk in nowhere.

A body is brought into touch by moving it until it presses a few millimetres into what supports it.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from mover.bodies.skinning import open_body
from mover.core.records import record
from mover_bench.rooms.placed import FAR, Placed, corners, distances
from mover_bench.rooms.poses import AT, Person, Posture, moved, skinned

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


def gap(person: Person, posture: Posture, piece: Placed, group: str) -> float:
    """Distance from a part of the body (one frame) to a piece; negative: inside [m]."""
    return float(distances(piece, skinned(person, posture, part(group))[0], 0.6).min())


def approach(distance: Callable[[float], float], start: float, speed: float, most: float) -> float:
    """The first value after `start` at which the distance has shrunk to `-PRESS`.

    `distance` is that of a part of the body to an object for a value (a height, an angle) [m]. No
    point of the part moves farther than `speed` for one unit of the value; its sign is that of the
    way to go. The search gives up after a change of the value by `most`.
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


SINK = 0.02  # [m], deeper no body may be inside a piece
GAPE = 0.01  # [m], farther no touch may be off
SLACK = 1e-3  # [m], more than rounding
NONE, GROUND = -2, -1

RESTS = {
    "sit": ("lower",),
    "lean": ("lower", "trunk"),
    "lie": ("torso",),
    "left hand": ("left_hand",),
    "right hand": ("right_hand",),
}
"""Parts of the body that must touch the piece in use, by the name of the action."""
ON_FEET = frozenset({
    "walk", "sit down", "sit", "lean", "stand up", "reach", "left hand", "right hand",
})  # fmt: skip


@record
class Nearness:
    """How near the skin is to what stands around."""

    distance: Float[np.ndarray, "frames verts"]
    """To the nearest piece or the floor, negative inside, at most `placed.FAR` [m]."""
    nearest: Int[np.ndarray, "frames verts"]  #: index of that piece; -1 the ground


def nearness(skin: Float[np.ndarray, "frames verts 3"], pieces: tuple[Placed, ...]) -> Nearness:
    """Distances of bodies on the floor (y = 0) to everything."""
    distance = skin[..., 1].copy()
    nearest = np.full(distance.shape, GROUND)
    boxes = skin.min(1), skin.max(1)
    for index, piece in enumerate(pieces):
        one = around(piece, skin, boxes, FAR)
        nearest[one < distance] = index
        distance = np.minimum(distance, one)
    return Nearness(distance, nearest)


def around(
    piece: Placed,
    skin: Float[np.ndarray, "frames verts 3"],
    boxes: tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 3"]],
    far: float,
) -> Float[np.ndarray, "frames verts"]:
    """Signed distance of bodies to a piece, at most `far` [m]; bodies beside it are skipped."""
    floor, height = corners(piece, far + SLACK), piece.furniture.size[1]
    low, high = floor.min(0), floor.max(0)
    low, high = np.array([low[0], -far, low[1]]), np.array([high[0], height + far, high[1]])
    close = ((boxes[1] > low - SLACK) & (boxes[0] < high + SLACK)).all(-1)
    found = np.full(skin.shape[:2], far)
    if close.any():
        found[close] = distances(piece, skin[close].reshape(-1, 3), far).reshape(-1, skin.shape[1])
    return found


def faults(
    person: Person, posture: Posture, label: str, pieces: tuple[Placed, ...], index: int
) -> list[str]:
    """Why these frames are not true: what sinks in, what hangs in the air.

    `index` is the piece that is used.
    """
    skin = skinned(person, posture)
    boxes = skin.min(1), skin.max(1)
    found: list[str] = []
    for piece in pieces:
        near = around(piece, skin, boxes, 0.0)
        deep = -float(near.min())
        if deep > SINK:
            model = open_body()
            joint = int(model.weights[int(near.argmin()) % skin.shape[1]].argmax())
            where = model.joint_names[joint]
            found.append(f"{label}: {where} {100 * deep:.1f} cm inside {piece.id}")
    for name in RESTS.get(label, ()):
        mask = part(name)
        near = distances(pieces[index], skin[:, mask].reshape(-1, 3)).reshape(len(skin), -1).min(1)
        if near.max() > GAPE:
            found.append(f"{label}: {name} {100 * near.max():.1f} cm off {pieces[index].id}")
    low = skin[..., 1].min(1)
    if low.min() < -SINK:
        found.append(f"{label}: {-100 * low.min():.1f} cm under the floor")
    if label in ON_FEET and low.max() > GAPE:
        found.append(f"{label}: feet {100 * low.max():.1f} cm above the floor")
    return found
