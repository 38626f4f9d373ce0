"""What is true of a body among furniture: how deep it sinks, what it touches, where it gapes."""

import numpy as np
from jaxtyping import Float, Int

from ..records import record
from .person import Person
from .placed import FAR, Placed, distances
from .poses import Posture, skinned
from .settle import part, part_of

SINK = 0.02  # [m], deeper no body may be inside a piece
GAPE = 0.01  # [m], farther no touch may be off
NONE, GROUND = -2, -1

RESTS = {
    "sit": ("lower",),
    "lean": ("lower", "trunk"),
    "lie": ("torso",),
    "left hand": ("left_hand",),
    "right hand": ("right_hand",),
}
"""Parts of the body that must touch the piece in use, by the name of the action."""
ON_FEET = frozenset(
    {"walk", "sit down", "sit", "lean", "stand up", "reach", "left hand", "right hand"}
)


@record
class Nearness:
    """How near the skin is to what stands around."""

    distance: Float[np.ndarray, "frames verts"]
    """To the nearest piece or the floor, negative inside, at most `placed.FAR` [m]."""
    nearest: Int[np.ndarray, "frames verts"]
    """Index of that piece; -1 the ground."""


def nearness(skin: Float[np.ndarray, "frames verts 3"], pieces: tuple[Placed, ...]) -> Nearness:
    """Distances of bodies on the floor (y = 0) to everything."""
    distance = skin[..., 1].copy()
    nearest = np.full(distance.shape, GROUND)
    flat = skin.reshape(-1, 3)
    for index, piece in enumerate(pieces):
        one = distances(piece, flat).reshape(distance.shape)
        nearest[one < distance] = index
        distance = np.minimum(distance, one)
    return Nearness(distance, nearest)


def faults(
    person: Person,
    posture: Posture,
    label: str,
    pieces: tuple[Placed, ...],
    index: int,
    apart: float = 0.0,
) -> list[str]:
    """Why these frames are not true: what sinks in, what hangs in the air, what comes too near.

    Args:
        person: Whose skin.
        posture: The frames.
        label: What is done in them.
        pieces: All furniture.
        index: The piece that is used.
        apart: More than 0: how far the skin must stay from furniture [m].
    """
    skin = skinned(person, posture)
    flat = skin.reshape(-1, 3)
    found: list[str] = []
    for piece in pieces:
        near = distances(piece, flat, max(FAR, apart))
        if apart > 0 and near.min() < apart:
            found.append(f"{label}: {100 * near.min():.1f} cm from {piece.id}")
        deep = -float(near.min())
        if deep > SINK:
            where = part_of(int(near.argmin()) % skin.shape[1])
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
