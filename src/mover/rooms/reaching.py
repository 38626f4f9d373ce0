"""Standing at a table with a hand on it."""

import dataclasses

import numpy as np

from .person import ARM, Person
from .placed import Placed, on_floor
from .poses import Posture, blend, chain, chest_of
from .seating import standing
from .settle import approach, gap, part
from .turns import X, about, facing, left_of, smooth

REACH_TIME = 1.6  # [s]
AWAY = 0.22  # [m], from the edge to the middle of the body
INSIDE = 0.1  # [m], from the edge to the wrist
HANDS = ("left_hand", "right_hand")


def table_stand(
    pieces: tuple[Placed, ...], index: int, side: int, along: float
) -> tuple[np.ndarray, float]:
    """Where one stands at a table (x, z) [m] and where one looks [rad].

    Sides 0 to 3 are its front, left, back and right; `along` is the offset along that side [m].
    """
    piece = pieces[index]
    w, _, d = piece.furniture.size
    x, z = [
        (along, d / 2 + AWAY),
        (w / 2 + AWAY, along),
        (along, -d / 2 - AWAY),
        (-w / 2 - AWAY, along),
    ][side]
    return on_floor(piece, x, z), piece.heading + [np.pi, -np.pi / 2, 0.0, np.pi / 2][side]


def hand_on(person: Person, place: np.ndarray, heading: float, piece: Placed, hand: int) -> Posture:
    """One frame of standing, bent as far as needed, one palm (0 left, 1 right) on the top."""
    stand = standing(person, place, heading)
    ahead, aside = facing(np.array(heading)), left_of(np.array(heading))
    out = 0.2 if hand == 0 else -0.2
    flat = place + (AWAY + INSIDE) * ahead + out * aside
    goal = np.array([flat[0], piece.furniture.top_height + palm_height(person), flat[1]])

    def bent(angle: float) -> Posture:
        move = np.array([0.25 * ahead[0], -0.05, 0.25 * ahead[1]]) * [-1, 1, -1]
        lean = -0.4 if hand == 0 else 0.4
        return dataclasses.replace(
            stand,
            pelvis=stand.pelvis + np.sin(angle) * move[None],
            turn=stand.turn @ about(X, np.array([0.45 * angle])),
            spine=stand.spine + angle * np.array([[0.55, 0, lean]]),
            head=np.array([[-0.3 * angle, 0.0]]),
        )

    angle = 0.0
    while angle < 1.0 and _span(person, bent(angle), hand, goal) > 0.975 * person.arm:
        angle += 0.02
    palms, resting = np.zeros((1, 2, 3)), np.zeros((1, 2))
    resting[0, hand] = 1.0

    def touching(rise: float) -> Posture:
        palms[0, hand] = goal + np.array([0.0, rise, 0.0])
        return dataclasses.replace(bent(angle), palms=palms.copy(), resting=resting)

    name = HANDS[hand]
    return touching(approach(lambda y: gap(person, touching(y), piece, name), 0.06, -1.0, 0.1))


def palm_height(person: Person) -> float:
    """Height of the wrist above a hand's lowest skin when the palm is level [m]."""
    wrist = person.joints[ARM[0][2]]
    return float(wrist[1] - person.skin[part(HANDS[0]), 1].min())


def _span(person: Person, posture: Posture, hand: int, goal: np.ndarray) -> float:
    return float(np.linalg.norm(goal - chest_of(person, posture)[1][0, hand]))


def reach_out(end: Posture, stand: Posture, share: np.ndarray) -> Posture:
    """From standing (share 0) over a raised hand to the hand on the top (share 1)."""
    hand = int(end.resting[0].argmax())
    half = blend(stand, end, np.array([0.5]))
    wrists = half.wrists.copy()
    wrists[0, hand] = np.array([0.05 if hand == 0 else -0.05, -0.2, 0.13])
    palms = np.where(end.resting[..., None] > 0, end.palms, half.palms)
    raised = dataclasses.replace(half, wrists=wrists, palms=palms, resting=np.zeros((1, 2)))
    start = dataclasses.replace(stand, palms=palms)
    goal = dataclasses.replace(end, wrists=wrists)
    first, second = share[share < 0.5], share[share >= 0.5]
    parts = []
    if len(first):
        parts.append(blend(start, raised, smooth(2 * first)))
    if len(second):
        parts.append(blend(raised, goal, smooth(2 * second - 1)))
    return chain(parts)
