"""Walking: footsteps along a path, and the body that they carry.

A foot stays where it landed until it swings again; the heel rises about the ball of the foot when
the body moves on. The pelvis runs through the middle between the feet.
"""

import numpy as np
from jaxtyping import Float

from .person import LEG, Person
from .poses import Posture
from .steps import STEP, STEP_TIME, Stations, Steps, steps_of
from .turns import X, Y, about, apply, facing, left_of, smooth

LIFT = 0.07  # [m], of the ankle in mid-swing
SWING = (0.12, 0.94)  # share of the step's time during which the foot is in the air
REACH = 0.985  # share of the leg's length that a planted leg may span
ARM_SWING = np.radians(20)


def walk(person: Person, way: Stations, times: Float[np.ndarray, " frames"]) -> Posture:
    """The body at `times` [s] after the start of the walk."""
    from scipy.interpolate import CubicSpline

    steps = steps_of(way)
    clock = STEP_TIME * np.arange(len(way.place) + 1)
    middle = np.concatenate([way.place[:1], (way.place[1:] + way.place[:-1]) / 2, way.place[-1:]])
    mean = np.concatenate(
        [way.heading[:1], (way.heading[1:] + way.heading[:-1]) / 2, way.heading[-1:]]
    )
    route = CubicSpline(clock, np.column_stack([middle, mean]), bc_type="clamped")
    now = np.clip(times, 0, clock[-1])
    x, z, heading = route(now).T
    speed = np.linalg.norm(route(now, 1)[:, :2], axis=1)
    stride = np.clip(speed / (STEP / STEP_TIME), 0, 1)
    pelvis = _carried(person, (x, z, heading), steps, now, stride)
    return _stepping(person, (pelvis, heading, stride), steps, now)


def _carried(
    person: Person,
    route: tuple[np.ndarray, np.ndarray, np.ndarray],
    steps: Steps,
    now: np.ndarray,
    stride: np.ndarray,
) -> Float[np.ndarray, "frames 3"]:
    """The pelvis falls and rises with the steps and sways over the standing foot."""
    x, z, heading = route
    share = (now / STEP_TIME) % 1.0
    leg = REACH * person.leg
    drop = leg - np.sqrt(leg**2 - (0.52 * STEP) ** 2)
    bob = drop * stride * (0.5 + 0.5 * np.cos(2 * np.pi * share))
    index = np.minimum((now / STEP_TIME).astype(int) + 2, len(steps.side) - 1)
    stance = 1 - 2 * (1 - steps.side[index])
    moving = np.where(now < STEP_TIME * (len(steps.side) - 2), 1.0, 0.0)
    sway = 0.02 * stance * np.sin(np.pi * share) * moving
    side = left_of(heading) * sway[:, None]
    y = person.standing - 0.004 * stride - bob
    return np.stack([x + side[:, 0], y, z + side[:, 1]], -1)


def _stepping(
    person: Person,
    body: tuple[np.ndarray, np.ndarray, np.ndarray],
    steps: Steps,
    now: np.ndarray,
) -> Posture:
    pelvis, heading, stride = body
    feet = [_foot(person, k, (pelvis, heading), steps, now) for k in (0, 1)]
    ankles, turns, toes, yaws = (np.stack(part, 1) for part in zip(*feet, strict=True))
    forward = ((ankles[:, 0] - ankles[:, 1])[:, [0, 2]] * facing(heading)).sum(-1)
    swing = ARM_SWING * np.clip(-forward / STEP, -1, 1)
    lean = np.radians(3) * stride
    turn = about(Y, heading) @ about(Y, -0.25 * swing) @ about(X, lean * 0.5)
    knees = facing(0.5 * (yaws + heading[:, None]))
    zero = np.zeros((len(now), 2))
    return Posture(
        pelvis=pelvis,
        turn=turn,
        spine=np.stack([lean * 0.5, 0.6 * swing, 0 * swing], -1),
        head=np.stack([np.full(len(now), 0.05), -0.35 * swing], -1),
        ankles=ankles,
        feet=turns,
        toes=toes,
        knees=np.stack([knees[..., 0], np.full_like(zero, 0.15), knees[..., 1]], -1),
        wrists=hanging(person, np.stack([swing, -swing], -1)),
        elbows=np.broadcast_to([[0.25, 0, -1], [-0.25, 0, -1]], (len(now), 2, 3)).copy(),
        palms=np.zeros((len(now), 2, 3)),
        resting=zero,
    )


def hanging(
    person: Person, swing: Float[np.ndarray, "frames 2"]
) -> Float[np.ndarray, "frames 2 3"]:
    """Wrists of arms that hang a little bent; `swing` is forward [rad]."""
    reach = person.arm * (0.965 - 0.03 * np.abs(swing))
    angle = swing + 0.12
    out = np.array([0.2, -0.2]) * reach
    down, ahead = -np.cos(angle) * reach, np.sin(angle) * reach
    return np.stack([out, down, ahead], -1)


def _foot(
    person: Person, side: int, body: tuple[np.ndarray, np.ndarray], steps: Steps, now: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Ankle, rotation, bend of the toes and heading of one foot in each frame."""
    pelvis, heading = body
    mine = np.flatnonzero(steps.side == side)
    lands = np.maximum((mine - 1) * STEP_TIME, 0.0)
    last = np.searchsorted(lands[1:], now + 1e-9, side="right")
    coming = np.minimum(last + 1, len(mine) - 1)
    begin = lands[coming] - STEP_TIME
    share = np.clip(((now - begin) / STEP_TIME - SWING[0]) / (SWING[1] - SWING[0]), 0, 1)
    share = np.where(coming == last, 0.0, share)
    ease = smooth(share)[:, None]
    place = (1 - ease) * steps.place[mine[last]] + ease * steps.place[mine[coming]]
    yaw = (1 - ease[:, 0]) * steps.heading[mine[last]] + ease[:, 0] * steps.heading[mine[coming]]
    rise = _heel_rise(person, side, (pelvis, heading), (place, yaw))
    air = np.sin(np.pi * share)
    rise = np.where(share > 0, rise * (1 - smooth(share)), rise)
    turn = about(Y, yaw) @ about(X, rise)
    ball = person.joints[LEG[side][3]] - person.joints[LEG[side][2]]
    flat = np.stack([place[:, 0], np.full(len(now), person.ankle), place[:, 1]], -1)
    ankle = (
        flat
        + apply(about(Y, yaw), np.broadcast_to(ball, flat.shape))
        - apply(turn, np.broadcast_to(ball, flat.shape))
    )
    ankle = ankle + np.stack([0 * air, LIFT * air**2, 0 * air], -1)
    return ankle, turn, rise, yaw


def _heel_rise(
    person: Person,
    side: int,
    body: tuple[np.ndarray, np.ndarray],
    foot: tuple[np.ndarray, np.ndarray],
) -> Float[np.ndarray, " frames"]:
    """Smallest angle about the ball that lets the leg reach the planted foot [rad]."""
    pelvis, heading = body
    place, yaw = foot
    hip = pelvis + apply(
        about(Y, heading), np.broadcast_to(person.joints[LEG[side][0]], pelvis.shape)
    )
    ball = np.broadcast_to(person.joints[LEG[side][3]] - person.joints[LEG[side][2]], pelvis.shape)
    flat = np.stack([place[:, 0], np.full(len(place), person.ankle), place[:, 1]], -1)
    low, high = np.zeros(len(place)), np.full(len(place), 0.9)
    fixed = flat + apply(about(Y, yaw), ball)
    for _ in range(20):
        middle = (low + high) / 2
        ankle = fixed - apply(about(Y, yaw) @ about(X, middle), ball)
        short = np.linalg.norm(hip - ankle, axis=-1) > REACH * person.leg
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.where(high < 1e-4, 0.0, high)
