"""How people rest on furniture: seated, leaning back, lying, standing with a hand on a table."""

from dataclasses import replace

import numpy as np

from mover.core.records import record
from mover.furniture.library import canonical
from mover_bench.rooms.gait import Stations, walk
from mover_bench.rooms.placed import Placed, Spot, on_floor
from mover_bench.rooms.poses import (
    ARM,
    LEG,
    SIDES,
    Person,
    Posture,
    X,
    Y,
    about,
    apply,
    blend,
    chain,
    chest_of,
    facing,
    from_vector,
    left_of,
    moved,
    rows,
    smooth,
)
from mover_bench.rooms.truth import approach, gap, laid, part, rest_on

SIT_TIME = 1.8  # [s]
BOW = np.radians(32)  # how far one bends forward on the way down
CALF = 0.12  # [m], the ankles stay this far before the edge


def seat_spot(pieces: tuple[Placed, ...], index: int, along: float = 0.0) -> Spot:
    """The front edge of a seat; `along` is the offset to the sitter's left [m]."""
    piece = pieces[index]
    seat = piece.furniture
    middle = (seat.seat_left + seat.seat_right) / 2
    edge = on_floor(piece, middle + along, seat.seat_front)
    return Spot(edge, piece.heading, seat.seat_height, seat.seat_depth, 0.0)


def bed_spot(pieces: tuple[Placed, ...], index: int, side: int, along: float) -> Spot:
    """A long edge of a bed: `side` +1 is its left; `along` runs towards its foot end [m]."""
    piece = pieces[index]
    bed = piece.furniture
    edge = on_floor(piece, bed.seat_right if side > 0 else bed.seat_left, along)
    width = bed.seat_right - bed.seat_left
    lip = bed.size[0] / 2 - bed.seat_right
    return Spot(edge, piece.heading + side * np.pi / 2, bed.seat_height, width, lip)


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
        return replace(stand, pelvis=pelvis, spine=np.array([[0.06, 0, 0]]))

    top = spot.height + 0.16
    height = approach(lambda y: gap(person, at(y), piece, "core"), top, -1.0, 0.2)
    return hands_on_thighs(person, at(height))


def hands_on_thighs(person: Person, posture: Posture) -> Posture:
    """Wrists above the middle of the thighs, elbows out."""
    goals = []
    for k in range(len(SIDES)):
        hip = posture.pelvis + apply(posture.turn, person.joints[LEG[k][0]])
        reach = person.joints[LEG[k][1]] - person.joints[LEG[k][0]]
        ahead = posture.ankles[:, k] - hip
        ahead = ahead * [1, 0, 1] / np.linalg.norm(ahead * [1, 0, 1], axis=-1, keepdims=True)
        thigh = np.linalg.norm(reach)
        goals.append(hip + 0.5 * thigh * ahead + np.array([0, 0.115, 0]))
    frames = len(posture.pelvis)
    elbows = np.broadcast_to([[0.45, -0.3, -0.8], [-0.45, -0.3, -0.8]], (frames, 2, 3)).copy()
    return replace(_hands_at(person, posture, goals), elbows=elbows)


def _hands_at(person: Person, posture: Posture, goals: list[np.ndarray]) -> Posture:
    """The left and the right wrist at places in the room [m]."""
    chest, shoulders = chest_of(person, posture)
    turn = np.swapaxes(chest, 1, 2)
    wrists = [apply(turn, goal - shoulders[:, k]) for k, goal in enumerate(goals)]
    return replace(posture, wrists=np.stack(wrists, 1))


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
    return replace(down, pelvis=pelvis, turn=turn, spine=spine)


def leaning(person: Person, sitting: Posture, piece: Placed) -> Posture:
    """Recline until the back presses on the backrest; the seat keeps its touch."""

    def at(angle: float, drop: float = 0.0) -> Posture:
        down = sitting.pelvis - np.array([[0.0, drop, 0.0]])
        return replace(
            sitting, pelvis=down, turn=sitting.turn @ about(X, np.array([-0.45 * angle])),
            spine=sitting.spine - np.array([[0.55 * angle, 0, 0]]),
            head=sitting.head + np.array([[0.5 * angle, 0]]),
        )  # fmt: skip

    angle, drop, most = 0.0, 0.0, np.radians(50)
    for _ in range(2):  # the pelvis tips when one leans, so the seat is met again
        start = 0.8 * angle
        angle = approach(lambda a, d=drop: gap(person, at(a, d), piece, "trunk"), start, 0.62, most)
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
    return replace(posture, spine=spine, head=head, wrists=posture.wrists + np.abs(wave))


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
    x, z = [(along, d / 2 + AWAY), (w / 2 + AWAY, along), (along, -d / 2 - AWAY),
            (-w / 2 - AWAY, along)][side]  # fmt: skip
    return on_floor(piece, x, z), piece.heading + [np.pi, -np.pi / 2, 0.0, np.pi / 2][side]


def hand_on(person: Person, place: np.ndarray, heading: float, piece: Placed, hand: int) -> Posture:
    """One frame of standing, bent as far as needed, one palm (0 left, 1 right) on the top."""
    stand = standing(person, place, heading)
    ahead, aside = facing(np.array(heading)), left_of(np.array(heading))
    out = 0.2 if hand == 0 else -0.2
    flat = place + (AWAY + INSIDE) * ahead + out * aside
    goal = np.array([flat[0], piece.furniture.top_height + palm_height(person), flat[1]])

    def bent(angle: float) -> Posture:
        back = -np.sin(angle) * np.array([0.25 * ahead[0], 0.05, 0.25 * ahead[1]])
        lean = -0.4 if hand == 0 else 0.4
        return replace(
            stand, pelvis=stand.pelvis + back[None],
            turn=stand.turn @ about(X, np.array([0.45 * angle])),
            spine=stand.spine + angle * np.array([[0.55, 0, lean]]),
            head=np.array([[-0.3 * angle, 0.0]]),
        )  # fmt: skip

    def away(angle: float) -> float:
        return float(np.linalg.norm(goal - chest_of(person, bent(angle))[1][0, hand]))

    angle = 0.0
    while angle < 1.0 and away(angle) > 0.975 * person.arm:
        angle += 0.02
    palms, resting = np.zeros((1, 2, 3)), np.zeros((1, 2))
    resting[0, hand] = 1.0

    def touching(rise: float) -> Posture:
        palms[0, hand] = goal + np.array([0.0, rise, 0.0])
        return replace(bent(angle), palms=palms.copy(), resting=resting)

    name = HANDS[hand]
    return touching(approach(lambda y: gap(person, touching(y), piece, name), 0.06, -1.0, 0.1))


def palm_height(person: Person) -> float:
    """Height of the wrist above a hand's lowest skin when the palm is level [m]."""
    wrist = person.joints[ARM[0][2]]
    return float(wrist[1] - person.skin[part(HANDS[0]), 1].min())


def reach_out(end: Posture, stand: Posture, share: np.ndarray) -> Posture:
    """From standing (share 0) over raised hands to the hands on the top (share 1)."""
    half = blend(stand, end, np.array([0.5]))
    wrists = half.wrists.copy()
    for hand in np.flatnonzero(end.resting[0]):
        wrists[0, hand] = np.array([0.05 if hand == 0 else -0.05, -0.2, 0.13])
    palms = np.where(end.resting[..., None] > 0, end.palms, half.palms)
    raised = replace(half, wrists=wrists, palms=palms, resting=np.zeros((1, 2)))
    start = replace(stand, palms=palms)
    goal = replace(end, wrists=wrists)
    first, second = share[share < 0.5], share[share >= 0.5]
    parts = ((start, raised, 2 * first), (raised, goal, 2 * second - 1))
    return chain([blend(a, b, smooth(part)) for a, b, part in parts if len(part)])


LIE_TIME = 2.6  # [s]
ROLL = np.radians(58)  # from the back towards the side
UP = np.array([0.0, 1.0, 0.0])


@record
class Berth:
    """Where one lies on a piece, and the edge from which one gets there."""

    spot: Spot  #: the edge: straight beside the pelvis
    behind: float  #: how far the lying pelvis is behind the edge [m]
    head: float  #: heading of the direction from the pelvis to the head [rad]
    knees_up: bool  #: there is no room to stretch


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
    hips = [pelvis + apply(turn, np.array([[out * 0.17, 0.0, 0.12]])) for out in (1.0, -1.0)]
    straight = _hands_at(person, _stretched(person, pelvis, turn, place), hips)
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
    return Posture(
        pelvis=pelvis, turn=turn, spine=np.zeros((1, 3)), head=np.zeros((1, 2)),
        ankles=np.stack(ankles, 1), feet=np.stack(feet, 1), toes=np.zeros((1, 2)),
        knees=np.broadcast_to(UP, (1, 2, 3)).copy(), wrists=zero + np.array([0.0, -0.4, 0.1]),
        elbows=np.array([[[0.3, 0.0, 1.0], [-0.3, 0.0, 1.0]]]), palms=zero,
        resting=np.zeros((1, 2)),
    )  # fmt: skip


def _heels_down(person: Person, lying: Posture, place: Berth) -> Posture:
    """Feet at the height at which the heels, or the soles, rest on the surface."""
    sole = part("feet")
    ankles = lying.ankles.copy()
    for k in range(2):
        joint = person.joints[LEG[k][2]]
        side = sole & (person.skin[:, 0] * joint[0] > 0)
        low = apply(lying.feet[0, k], person.skin[side] - joint)[:, 1].min()
        ankles[:, k, 1] = place.spot.height - low
    return replace(lying, ankles=ankles)


def _head_down(person: Person, lying: Posture, piece: Placed) -> Posture:
    """Nod less and less until the head rests on the pillow, or the neck is straight."""

    def nodding(nod: float) -> Posture:
        return replace(lying, head=np.array([[nod, 0.0]]))

    return nodding(approach(lambda a: gap(person, nodding(a), piece, "head"), 0.8, -0.3, 0.95))


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
    side = replace(
        back, turn=turn, ankles=np.stack(ankles, 1), feet=np.stack(feet, 1),
        knees=np.repeat((towards + 0.15 * UP)[None, None], 2, axis=1),
    )  # fmt: skip
    side = laid(person, side, piece, "torso")
    lower = 0 if sign > 0 else 1
    high = np.zeros((1, 2, 3))
    high[0, 1 - lower, 1] = 0.12
    side = _heels_down(person, side, place)
    side = replace(side, ankles=side.ankles + high)
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
    up = apply(np.swapaxes(chest_of(person, lying)[0], 1, 2), UP[None])
    elbows = np.stack([up, up], 1)
    return replace(lying, palms=palms, resting=np.ones((1, 2)), elbows=elbows)


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
    posture = replace(posture, ankles=ankles)
    rise = np.maximum(rest_on(person, posture, piece, "all"), 0.0)
    return moved(posture, rise[:, None] * UP)


def roll_over(
    person: Person, start: Posture, end: Posture, piece: Placed, share: np.ndarray
) -> Posture:
    """From one way of lying to another, always resting on the piece."""
    hands = end.resting[..., None] > 0
    start = replace(start, palms=np.where(hands, end.palms, start.palms))
    posture = blend(start, end, smooth(share))
    rise = 0.06 * np.sin(np.pi * np.clip(share, 0, 1))[:, None, None] * UP
    posture = replace(posture, palms=posture.palms + rise)
    return laid(person, posture, piece, "torso")
