"""Sitting (down on an edge, upright, leaning back, up again), and a hand on a table."""

import dataclasses

import numpy as np

from mover_bench.rooms.gait import Stations, walk
from mover_bench.rooms.placed import Placed, Spot, on_floor
from mover_bench.rooms.poses import ARM, LEG, SIDES, Person, Posture, blend, chain, chest_of, rows
from mover_bench.rooms.truth import approach, gap, part
from mover_bench.rooms.turns import X, about, apply, facing, left_of, smooth

SIT_TIME = 1.8  # [s]
BOW = np.radians(32)  # how far one bends forward on the way down
CALF = 0.12  # [m], the ankles stay this far before the edge


def seat_spot(pieces: tuple[Placed, ...], index: int, along: float = 0.0) -> Spot:
    """The front edge of a seat; `along` is the offset to the sitter's left [m]."""
    piece = pieces[index]
    seat = piece.furniture
    middle = (seat.seat_left + seat.seat_right) / 2
    edge = on_floor(piece, middle + along, seat.seat_front)
    back = seat.back_height > 0
    return Spot(edge, piece.heading, seat.seat_height, seat.seat_depth, 0.0, back, index)


def bed_spot(pieces: tuple[Placed, ...], index: int, side: int, along: float) -> Spot:
    """A long edge of a bed: `side` +1 is its left; `along` runs towards its foot end [m]."""
    piece = pieces[index]
    bed = piece.furniture
    edge = on_floor(piece, bed.seat_right if side > 0 else bed.seat_left, along)
    width = bed.seat_right - bed.seat_left
    lip = bed.size[0] / 2 - bed.seat_right
    heading = piece.heading + side * np.pi / 2
    return Spot(edge, heading, bed.seat_height, width, lip, False, index)


def before(person: Person, spot: Spot) -> np.ndarray:
    """Where one stands before sitting down, and where the feet stay (x, z) [m]."""
    return spot.edge + _depths(person, spot)[1] * facing(np.array(spot.heading))


def _depths(person: Person, spot: Spot) -> tuple[float, float]:
    """How far the pelvis is behind the edge and the ankles are before it [m]."""
    hip, knee = person.joints[LEG[0][0]], person.joints[LEG[0][1]]
    thigh = float(np.linalg.norm(knee - hip))
    rear = -float(person.skin[np.abs(person.skin[:, 1]) < 0.15, 2].min())
    high = max(0.0, spot.height - 0.42)  # high seats: nearer to the edge, knees lower than hips
    behind = min(thigh - 0.1 - high - spot.lip, spot.depth - rear - 0.045)
    return behind, max(CALF + spot.lip, thigh - behind - 0.02)


def standing(person: Person, place: np.ndarray, heading: float) -> Posture:
    """One frame of standing still."""
    way = Stations(place[None], np.array([heading]))
    return walk(person, way, np.zeros(1))


def seated(person: Person, spot: Spot, piece: Placed) -> Posture:
    """One frame of sitting upright, hands on the thighs, pressed on the seat."""
    stand = standing(person, before(person, spot), spot.heading)
    behind = spot.edge - _depths(person, spot)[0] * facing(np.array(spot.heading))

    def at(height: float) -> Posture:
        pelvis = np.array([[behind[0], height, behind[1]]])
        return dataclasses.replace(stand, pelvis=pelvis, spine=np.array([[0.06, 0, 0]]))

    top = spot.height + 0.16
    height = approach(lambda y: gap(person, at(y), piece, "core"), top, -1.0, 0.2)
    return hands_on_thighs(person, at(height))


def hands_on_thighs(person: Person, posture: Posture) -> Posture:
    """Wrists above the middle of the thighs, elbows out."""
    chest, shoulders = chest_of(person, posture)
    wrists = []
    for k in range(len(SIDES)):
        hip = posture.pelvis + apply(posture.turn, person.joints[LEG[k][0]])
        reach = person.joints[LEG[k][1]] - person.joints[LEG[k][0]]
        ahead = posture.ankles[:, k] - hip
        ahead = ahead * [1, 0, 1] / np.linalg.norm(ahead * [1, 0, 1], axis=-1, keepdims=True)
        thigh = np.linalg.norm(reach)
        goal = hip + 0.5 * thigh * ahead + np.array([0, 0.115, 0])
        wrists.append(apply(np.swapaxes(chest, 1, 2), goal - shoulders[:, k]))
    frames = len(posture.pelvis)
    elbows = np.broadcast_to([[0.45, -0.3, -0.8], [-0.45, -0.3, -0.8]], (frames, 2, 3)).copy()
    return dataclasses.replace(posture, wrists=np.stack(wrists, 1), elbows=elbows)


def sit_down(person: Person, end: Posture, heading: float, share: np.ndarray) -> Posture:
    """From standing (share 0) to a seated posture (share 1), bowing on the way."""
    feet = end.ankles.mean(1)[0, [0, 2]]
    start = standing(person, feet, heading)
    down = blend(start, end, smooth(share))
    back = smooth(np.clip((share - 0.08) / 0.92, 0, 1))[:, None]
    fall = smooth(np.clip(share / 0.95, 0, 1))[:, None]
    flat = (1 - back) * start.pelvis + back * end.pelvis
    high = (1 - fall) * start.pelvis + fall * end.pelvis
    bow = BOW * np.sin(np.pi * np.clip(share, 0, 1)) ** 2
    turn = down.turn @ about(X, 0.5 * bow)
    spine = down.spine + np.stack([0.6 * bow, 0 * bow, 0 * bow], -1)
    pelvis = np.stack([flat[:, 0], high[:, 1], flat[:, 2]], -1)
    return dataclasses.replace(down, pelvis=pelvis, turn=turn, spine=spine)


def leaning(person: Person, sitting: Posture, piece: Placed) -> Posture:
    """Recline until the back presses on the backrest; the seat keeps its touch."""

    def at(angle: float, drop: float = 0.0) -> Posture:
        down = sitting.pelvis - np.array([[0.0, drop, 0.0]])
        return dataclasses.replace(
            sitting,
            pelvis=down,
            turn=sitting.turn @ about(X, np.array([-0.45 * angle])),
            spine=sitting.spine - np.array([[0.55 * angle, 0, 0]]),
            head=sitting.head + np.array([[0.5 * angle, 0]]),
        )

    angle, drop = 0.0, 0.0
    for _ in range(2):  # the pelvis tips when one leans, so the seat is met again
        angle = approach(
            lambda a, d=drop: gap(person, at(a, d), piece, "trunk"),
            0.8 * angle,
            0.62,
            np.radians(50),
        )
        drop = approach(lambda d, a=angle: gap(person, at(a, d), piece, "core"), -0.04, 1.0, 0.08)
    return hands_on_thighs(person, at(angle, drop))


def settle_down(still: Posture, times: np.ndarray, phase: float, amount: float) -> Posture:
    """Small movements of head, trunk and hands; pelvis and feet rest."""
    frames = len(times)
    posture = rows(still, np.zeros(frames, dtype=int))
    fade = np.minimum(1.0, np.minimum(times, times[-1] - times) / 0.8) if frames > 1 else 0 * times
    slow, mid = (np.sin(2 * np.pi * times / p + phase) * fade for p in (4.1, 2.9))
    spine = posture.spine + amount * np.stack([0.03 * mid, 0.08 * slow, 0 * slow], -1)
    head = posture.head + np.stack([0.06 * mid, 0.3 * slow], -1)
    wave = np.stack([slow, mid], -1)[..., None] * np.array([0.0, 0.01, 0.02])
    return dataclasses.replace(
        posture, spine=spine, head=head, wrists=posture.wrists + np.abs(wave)
    )


# Standing at a table with a hand on it.


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


def bent_over(stand: Posture, heading: float, angle: float, lean: float = 0.0) -> Posture:
    """One frame of standing, bent forward over a table, and to a side [rad]."""
    ahead = facing(np.array(heading))
    back = -np.sin(angle) * np.array([0.25 * ahead[0], 0.05, 0.25 * ahead[1]])
    return dataclasses.replace(
        stand,
        pelvis=stand.pelvis + back[None],
        turn=stand.turn @ about(X, np.array([0.45 * angle])),
        spine=stand.spine + angle * np.array([[0.55, 0, lean]]),
        head=np.array([[-0.3 * angle, 0.0]]),
    )


def hand_on(person: Person, place: np.ndarray, heading: float, piece: Placed, hand: int) -> Posture:
    """One frame of standing, bent as far as needed, one palm (0 left, 1 right) on the top."""
    stand = standing(person, place, heading)
    ahead, aside = facing(np.array(heading)), left_of(np.array(heading))
    out = 0.2 if hand == 0 else -0.2
    flat = place + (AWAY + INSIDE) * ahead + out * aside
    goal = np.array([flat[0], piece.furniture.top_height + palm_height(person), flat[1]])

    def bent(angle: float) -> Posture:
        return bent_over(stand, heading, angle, -0.4 if hand == 0 else 0.4)

    angle = 0.0
    while angle < 1.0 and span(person, bent(angle), hand, goal) > 0.975 * person.arm:
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


def span(person: Person, posture: Posture, hand: int, goal: np.ndarray) -> float:
    """From a shoulder to a position [m]."""
    return float(np.linalg.norm(goal - chest_of(person, posture)[1][0, hand]))


def reach_out(end: Posture, stand: Posture, share: np.ndarray) -> Posture:
    """From standing (share 0) over raised hands to the hands on the top (share 1)."""
    half = blend(stand, end, np.array([0.5]))
    wrists = half.wrists.copy()
    for hand in np.flatnonzero(end.resting[0]):
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
