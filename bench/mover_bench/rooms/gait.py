"""Walking: stations of the body along a path, footsteps that lead there, and the body on them.

A foot stays where it landed until it swings again; the heel rises about the ball of the foot when
the body moves on. The pelvis runs through the middle between the feet.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from mover.core.records import record
from mover_bench.rooms.poses import (
    LEG,
    STANCE,
    Person,
    Posture,
    X,
    Y,
    about,
    apply,
    facing,
    heading_of,
    left_of,
    smooth,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

STEP = 0.5  # [m], length of an indoor step
STEP_TIME = 0.5  # [s]
TURN = np.radians(40)  # [rad], of one step on the spot

Floor = Float[np.ndarray, "_ 2"]


@record
class Steps:
    """Where the feet land; the first two rows are where they stood, left then right."""

    side: Int[np.ndarray, " steps"]
    place: Float[np.ndarray, "steps 2"]  #: x and z of the ankle [m]
    heading: Float[np.ndarray, " steps"]  #: of the foot [rad]


@record
class Stations:
    """Where the body stands when each step lands."""

    place: Float[np.ndarray, "steps 2"]
    heading: Float[np.ndarray, " steps"]


def stations(path: Floor, start: float, end: float, outer: Floor | None = None) -> Stations:
    """Turn on the spot, walk along a path on the floor, turn on the spot [rad, m].

    `start` and `end` are the headings at its ends; `outer` are two positions before and after it
    that are reached without turning: a step out of a seat, and a step back into the next one.
    """
    route = _rounded(path)
    lengths = np.linalg.norm(np.diff(route, axis=0), axis=1)
    total = float(lengths.sum())
    places: list[np.ndarray] = [path[0]] if outer is None else [outer[0], path[0]]
    headings: list[float] = [start] * len(places)
    if total > 0.05:
        walked, along = _paces(route, lengths)
        _turn_to(places, headings, float(along[0]), settle=False)
        along = along + 2 * np.pi * np.round((headings[-1] - along[0]) / (2 * np.pi))
        places += list(walked[1:])
        headings += list(along[1:])
    _turn_to(places, headings, end, settle=True)
    if outer is not None:
        places.append(outer[1])
        headings.append(headings[-1])
    return Stations(np.array(places), np.array(headings))


def _paces(route: Floor, lengths: np.ndarray) -> tuple[Floor, np.ndarray]:
    """Places and headings, a step apart, along a route."""
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    goals = np.linspace(0, at[-1], max(1, int(np.ceil(at[-1] / STEP))) + 1)
    walked = np.stack([np.interp(goals, at, route[:, k]) for k in (0, 1)], -1)
    ahead = np.interp(np.minimum(goals + 0.1, at[-1]), at, np.arange(len(at)))
    segment = np.minimum(ahead.astype(int), len(lengths) - 1)
    return walked, np.unwrap(heading_of(np.diff(route, axis=0)[segment]))


def _turn_to(places: list[np.ndarray], headings: list[float], goal: float, settle: bool) -> None:
    """Append stations on the spot until the heading is (almost) `goal`."""
    turn = float((goal - headings[-1] + np.pi) % (2 * np.pi) - np.pi)
    slack = 0.0 if settle else TURN
    count = int(np.ceil(max(0.0, abs(turn) - slack) / TURN - 1e-9))
    first = headings[-1]
    share = 1.0 if settle else max(0.0, abs(turn) - slack / 2) / max(abs(turn), 1e-9)
    for k in range(count):
        places.append(places[-1])
        headings.append(first + turn * share * (k + 1) / count)


def _rounded(path: Floor) -> Floor:
    """The path with its corners cut to arcs, sampled every 4 cm."""
    from scipy.ndimage import gaussian_filter1d

    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(2, int(at[-1] / 0.04) + 1)
    dense = np.stack([np.interp(np.linspace(0, at[-1], count), at, path[:, k]) for k in (0, 1)], -1)
    odd = 2 * np.array([dense[0], dense[-1]])
    pad = min(20, count - 1)
    long = np.concatenate([odd[0] - dense[pad:0:-1], dense, odd[1] - dense[-2 : -pad - 2 : -1]])
    return gaussian_filter1d(long, 4.0, axis=0)[pad : pad + count]


def steps_of(way: Stations) -> Steps:
    """Alternate feet on the stations, then bring the other foot beside the last."""
    places, headings = way.place, way.heading
    first = 0 if headings[min(1, len(places) - 1)] >= headings[0] else 1
    order = [(first + k) % 2 for k in range(len(places))]
    last = len(places) - 1
    rows = [(0, 0), (1, 0), *((order[k], k + 1) for k in range(last)), (order[last], last)]
    side = np.array([s for s, _ in rows])
    station = np.array([k for _, k in rows])
    out = (STANCE * (1 - 2 * side))[:, None] * left_of(headings[station])
    return Steps(side, places[station] + out, headings[station])


def duration(way: Stations) -> float:
    """Time of all steps [s]."""
    return STEP_TIME * len(way.place)


LIFT = 0.07  # [m], of the ankle in mid-swing
SWING = (0.12, 0.94)  # share of the step's time during which the foot is in the air
REACH = 0.985  # share of the leg's length that a planted leg may span
ARM_SWING = np.radians(20)


def walk(person: Person, way: Stations, times: Float[np.ndarray, " frames"]) -> Posture:
    """The body at `times` [s] after the start of the walk."""
    steps, route = steps_of(way), route_of(way)
    now = np.clip(times, 0, STEP_TIME * len(way.place))
    x, z, heading = route(now).T
    speed = np.linalg.norm(route(now, 1)[:, :2], axis=1)
    stride = np.clip(speed / (STEP / STEP_TIME), 0, 1)
    pelvis = _carried(person, np.stack([x, z], -1), heading, steps, now, stride)
    feet = [_foot(person, k, pelvis, heading, steps, now) for k in (0, 1)]
    ankles, turns, toes, yaws = (np.stack(part, 1) for part in zip(*feet, strict=True))
    forward = ((ankles[:, 0] - ankles[:, 1])[:, [0, 2]] * facing(heading)).sum(-1)
    swing = ARM_SWING * np.clip(-forward / STEP, -1, 1)
    lean = np.radians(3) * stride
    turn = about(Y, heading) @ about(Y, -0.25 * swing) @ about(X, lean * 0.5)
    knees = facing(0.5 * (yaws + heading[:, None]))
    zero = np.zeros((len(now), 2))
    return Posture(
        pelvis=pelvis, turn=turn, spine=np.stack([lean * 0.5, 0.6 * swing, 0 * swing], -1),
        head=np.stack([np.full(len(now), 0.05), -0.35 * swing], -1),
        ankles=ankles, feet=turns, toes=toes,
        knees=np.stack([knees[..., 0], np.full_like(zero, 0.15), knees[..., 1]], -1),
        wrists=_hanging(person, np.stack([swing, -swing], -1)),
        elbows=np.broadcast_to([[0.25, 0, -1], [-0.25, 0, -1]], (len(now), 2, 3)).copy(),
        palms=np.zeros((len(now), 2, 3)), resting=zero,
    )  # fmt: skip


def route_of(way: Stations) -> "CubicSpline":
    """Where the body is (x, z) and looks [m, rad] at a time of the walk [s], without sway."""
    from scipy.interpolate import CubicSpline

    clock = STEP_TIME * np.arange(len(way.place) + 1)
    rows = np.column_stack([way.place, way.heading])
    middle = np.concatenate([rows[:1], (rows[1:] + rows[:-1]) / 2, rows[-1:]])
    return CubicSpline(clock, middle, bc_type="clamped")


def _carried(
    person: Person, floor: Floor, heading: np.ndarray, steps: Steps, now: np.ndarray,
    stride: np.ndarray,
) -> Float[np.ndarray, "frames 3"]:  # fmt: skip
    """The pelvis falls and rises with the steps and sways over the standing foot."""
    share = (now / STEP_TIME) % 1.0
    leg = REACH * person.leg
    drop = leg - np.sqrt(leg**2 - (0.52 * STEP) ** 2)
    bob = drop * stride * (0.5 + 0.5 * np.cos(2 * np.pi * share))
    index = np.minimum((now / STEP_TIME).astype(int) + 2, len(steps.side) - 1)
    stance = 1 - 2 * (1 - steps.side[index])
    moving = np.where(now < STEP_TIME * (len(steps.side) - 2), 1.0, 0.0)
    sway = 0.02 * stance * np.sin(np.pi * share) * moving
    flat = floor + left_of(heading) * sway[:, None]
    return np.stack([flat[:, 0], person.standing - 0.004 * stride - bob, flat[:, 1]], -1)


def _hanging(
    person: Person, swing: Float[np.ndarray, "frames 2"]
) -> Float[np.ndarray, "frames 2 3"]:
    """Wrists of arms that hang a little bent; `swing` is forward [rad]."""
    reach = person.arm * (0.965 - 0.03 * np.abs(swing))
    angle = swing + 0.12
    out = np.array([0.2, -0.2]) * reach
    return np.stack([out, -np.cos(angle) * reach, np.sin(angle) * reach], -1)


def _foot(
    person: Person,
    side: int,
    pelvis: np.ndarray,
    heading: np.ndarray,
    steps: Steps,
    now: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Ankle, rotation, bend of the toes and heading of one foot in each frame."""
    mine = np.flatnonzero(steps.side == side)
    lands = np.maximum((mine - 1) * STEP_TIME, 0.0)
    last = np.searchsorted(lands[1:], now + 1e-9, side="right")
    coming = np.minimum(last + 1, len(mine) - 1)
    share = ((now - (lands[coming] - STEP_TIME)) / STEP_TIME - SWING[0]) / (SWING[1] - SWING[0])
    share = np.where(coming == last, 0.0, np.clip(share, 0, 1))
    ease = smooth(share)[:, None]
    place = (1 - ease) * steps.place[mine[last]] + ease * steps.place[mine[coming]]
    yaw = (1 - ease[:, 0]) * steps.heading[mine[last]] + ease[:, 0] * steps.heading[mine[coming]]
    flat = np.stack([place[:, 0], np.full(len(now), person.ankle), place[:, 1]], -1)
    hip, _, ankle, foot = (person.joints[j] for j in LEG[side])
    ball = np.broadcast_to(foot - ankle, flat.shape)
    hips = pelvis + apply(about(Y, heading), np.broadcast_to(hip, flat.shape))
    turn = about(Y, yaw)
    fixed = flat + apply(turn, ball)
    rise = _heel_rise(hips, fixed, turn, ball, REACH * person.leg)
    air = np.sin(np.pi * share)
    rise = np.where(share > 0, rise * (1 - smooth(share)), rise)
    turn = turn @ about(X, rise)
    lift = np.stack([0 * air, LIFT * air**2, 0 * air], -1)
    return fixed - apply(turn, ball) + lift, turn, rise, yaw


def _heel_rise(
    hips: np.ndarray, fixed: np.ndarray, turn: np.ndarray, ball: np.ndarray, reach: float
) -> Float[np.ndarray, " frames"]:
    """Smallest angle about the ball (at `fixed`) that lets the leg reach the planted foot [rad]."""
    low, high = np.zeros(len(hips)), np.full(len(hips), 0.9)
    for _ in range(20):
        middle = (low + high) / 2
        ankle = fixed - apply(turn @ about(X, middle), ball)
        short = np.linalg.norm(hips - ankle, axis=-1) > reach
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.where(high < 1e-4, 0.0, high)
