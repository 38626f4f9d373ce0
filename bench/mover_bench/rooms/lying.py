"""Lying on a bed or a sofa: from its edge onto the back, onto the side, and up again."""

import dataclasses

import numpy as np

from mover.core.records import record
from mover.furniture.library import canonical
from mover_bench.rooms.placed import Placed, Spot
from mover_bench.rooms.poses import LEG, Person, Posture, blend, chest_of, moved
from mover_bench.rooms.seating import bed_spot, palm_height, seat_spot
from mover_bench.rooms.truth import approach, gap, laid, part, rest_on
from mover_bench.rooms.turns import X, Y, about, apply, facing, from_vector, smooth

LIE_TIME = 2.6  # [s]
ROLL = np.radians(58)  # from the back towards the side
UP = np.array([0.0, 1.0, 0.0])


@record
class Berth:
    """Where one lies on a piece, and the edge from which one gets there."""

    spot: Spot
    """The edge: straight beside the pelvis."""
    behind: float
    """How far the lying pelvis is behind the edge [m]."""
    head: float
    """Heading of the direction from the pelvis to the head [rad]."""
    knees_up: bool
    """There is no room to stretch."""


def berth(person: Person, pieces: tuple[Placed, ...], index: int, side: int) -> Berth:
    """Where a person lies on a bed (from its `side`, +1 left) or sofa (head towards `side`).

    Raises:
        ValueError: If the piece is too short to lie on.
    """
    piece = pieces[index].furniture
    tall = float(person.skin[:, 1].max())
    if canonical(piece.category) == "bed":
        along = piece.seat_back + 0.1 + tall
        spot = bed_spot(pieces, index, side, along)
        behind = min(0.42, spot.depth / 2)
        return Berth(spot, behind, pieces[index].heading + np.pi, False)
    room = piece.seat_right - piece.seat_left
    stretched = room > float(np.ptp(person.skin[:, 1])) + 0.12
    if room < 1.3:
        raise ValueError(f"{pieces[index].id}: {room:.2f} m are too short to lie on")
    spot = seat_spot(pieces, index, side * (room / 2 - 0.06 - tall))
    return Berth(spot, 0.42 * spot.depth, spot.heading + side * np.pi / 2, not stretched)


def supine(person: Person, place: Berth, piece: Placed) -> Posture:
    """One frame of lying on the back, hands on the hips."""
    middle = place.spot.edge - place.behind * facing(np.array(place.spot.heading))
    pelvis = np.array([[middle[0], place.spot.height + 0.12, middle[1]]])
    turn = _flat(place.head)
    straight = _hands_on_hips(person, _stretched(person, pelvis, turn, place))
    lying = laid(person, straight, piece, "torso")
    return _head_down(person, _heels_down(person, lying, place), piece)


def _flat(head: float) -> np.ndarray:
    """The pelvis of a person on the back: the head towards a heading, the front upwards."""
    x, z = facing(np.array(head))
    along = np.array([x, 0.0, z])
    return np.stack([np.cross(along, UP), along, UP], -1)[None]


def _stretched(person: Person, pelvis: np.ndarray, turn: np.ndarray, place: Berth) -> Posture:
    ankles, feet = [], []
    for k, out in enumerate((1.0, -1.0)):
        hip = person.joints[LEG[k][0]]
        reach = 0.52 * person.leg if place.knees_up else 0.985 * person.leg
        low = np.array([out * 0.1, hip[1] - reach, 0.0])
        ankles.append(pelvis + apply(turn, low[None]))
        splay = about(Y, np.array([out * 0.15]))
        if place.knees_up:
            feet.append(about(Y, np.array([place.head + np.pi])) @ splay)
        else:
            feet.append(turn @ splay @ about(X, np.array([0.45])))
    zero = np.zeros((1, 2, 3))
    knees = np.broadcast_to(UP, (1, 2, 3)).copy()
    return Posture(
        pelvis=pelvis,
        turn=turn,
        spine=np.zeros((1, 3)),
        head=np.zeros((1, 2)),
        ankles=np.stack(ankles, 1),
        feet=np.stack(feet, 1),
        toes=np.zeros((1, 2)),
        knees=knees,
        wrists=zero + np.array([0.0, -0.4, 0.1]),
        elbows=np.array([[[0.3, 0.0, 1.0], [-0.3, 0.0, 1.0]]]),
        palms=zero,
        resting=np.zeros((1, 2)),
    )


def _heels_down(person: Person, lying: Posture, place: Berth) -> Posture:
    """Feet at the height at which the heels, or the soles, rest on the surface."""
    sole = part("feet")
    ankles = lying.ankles.copy()
    for k in range(2):
        joint = person.joints[LEG[k][2]]
        side = sole & (person.skin[:, 0] * joint[0] > 0)
        low = apply(lying.feet[0, k], person.skin[side] - joint)[:, 1].min()
        ankles[:, k, 1] = place.spot.height - low
    return dataclasses.replace(lying, ankles=ankles)


def _hands_on_hips(person: Person, lying: Posture) -> Posture:
    chest, shoulders = chest_of(person, lying)
    wrists = []
    for k, out in enumerate((1.0, -1.0)):
        place = lying.pelvis + apply(lying.turn, np.array([[out * 0.17, 0.0, 0.12]]))
        wrists.append(apply(np.swapaxes(chest, 1, 2), place - shoulders[:, k]))
    return dataclasses.replace(lying, wrists=np.stack(wrists, 1))


def _head_down(person: Person, lying: Posture, piece: Placed) -> Posture:
    """Nod less and less until the head rests on the pillow, or the neck is straight."""

    def nodding(nod: float) -> Posture:
        return dataclasses.replace(lying, head=np.array([[nod, 0.0]]))

    nod = approach(lambda a: gap(person, nodding(a), piece, "head"), 0.8, -0.3, 0.95)
    return nodding(nod)


def on_side(person: Person, back: Posture, place: Berth, piece: Placed) -> Posture:
    """One frame of lying half on the side, facing the edge, knees drawn up."""
    x, z = facing(np.array(place.head))
    along = np.array([x, 0.0, z])
    edge = facing(np.array(place.spot.heading))
    towards = np.array([edge[0], 0.0, edge[1]])
    sign = float(np.sign(np.cross(UP, towards) @ along))
    turn = from_vector(sign * ROLL * along) @ back.turn
    low = _flat(place.head) @ about(Y, np.array([sign * np.pi / 2]))
    ankles, feet = [], []
    for k in range(2):
        upper = (k == 0) == (sign < 0)
        reach = (0.72 if upper else 0.84) * person.leg
        middle = back.pelvis - (reach + 0.08) * along + 0.12 * towards
        ankles.append(middle + (0.11 if upper else 0.0) * UP)
        feet.append(low @ about(X, np.array([0.5])))
    side = dataclasses.replace(
        back, turn=turn, ankles=np.stack(ankles, 1), feet=np.stack(feet, 1),
        knees=np.repeat((towards + 0.15 * UP)[None, None], 2, axis=1),
    )  # fmt: skip
    side = laid(person, side, piece, "torso")
    lower = 0 if sign > 0 else 1
    high = np.zeros((1, 2, 3))
    high[0, 1 - lower, 1] = 0.12
    side = _heels_down(person, side, place)
    side = dataclasses.replace(side, ankles=side.ankles + high)
    return _head_down(person, _hands_before(person, side, place, lower), piece)


def _hands_before(person: Person, lying: Posture, place: Berth, lower: int) -> Posture:
    """Both hands on the surface before the chest, the `lower` arm stretched, elbows off it."""
    head, edge = facing(np.array(place.head)), facing(np.array(place.spot.heading))
    palms = np.zeros((1, 2, 3))
    for k in range(2):
        ahead, along = (0.4, 0.5) if k == lower else (0.28, 0.24)
        flat = min(ahead, place.behind - 0.02) * edge + along * head
        palms[:, k] = lying.pelvis + np.array([flat[0], 0, flat[1]])
        palms[:, k, 1] = place.spot.height + palm_height(person)
    chest, _ = chest_of(person, lying)
    up = apply(np.swapaxes(chest, 1, 2), UP[None])
    elbows = np.stack([up, up], 1)
    return dataclasses.replace(lying, palms=palms, resting=np.ones((1, 2)), elbows=elbows)


def lie_down(
    person: Person, sitting: Posture, lying: Posture, piece: Placed, share: np.ndarray
) -> Posture:
    """From the edge (share 0) onto the back (share 1); nothing sinks into the piece."""
    posture = blend(sitting, lying, smooth(share))
    lift = smooth(np.clip(share / 0.7, 0, 1))[:, None, None]
    across = smooth(np.clip((share - 0.2) / 0.8, 0, 1))[:, None, None]
    high = sitting.ankles + lift * (lying.ankles - sitting.ankles)
    flat = sitting.ankles + across * (lying.ankles - sitting.ankles)
    bump = 0.12 * np.sin(np.pi * np.clip(share, 0, 1)) ** 2
    ankles = np.stack([flat[..., 0], high[..., 1] + bump[:, None], flat[..., 2]], -1)
    posture = dataclasses.replace(posture, ankles=ankles)
    return _lifted(person, posture, piece)


def roll_over(
    person: Person, start: Posture, end: Posture, piece: Placed, share: np.ndarray
) -> Posture:
    """From one way of lying to another, always resting on the piece."""
    hands = end.resting[..., None] > 0
    start = dataclasses.replace(start, palms=np.where(hands, end.palms, start.palms))
    posture = blend(start, end, smooth(share))
    rise = 0.06 * np.sin(np.pi * np.clip(share, 0, 1))[:, None, None] * UP
    posture = dataclasses.replace(posture, palms=posture.palms + rise)
    return laid(person, posture, piece, "torso")


def _lifted(person: Person, posture: Posture, piece: Placed) -> Posture:
    rise = np.maximum(rest_on(person, posture, piece, "all"), 0.0)
    return moved(posture, rise[:, None] * UP)
