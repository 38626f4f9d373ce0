"""Sofas, beds, chairs, stools and benches: what one sits, leans and lies on."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from mover.furniture.pieces import (
    Furniture,
    Part,
    Seat,
    block,
    crosswise,
    disc,
    draw,
    finish,
    legs,
    pair,
    posts,
    rod,
    tilted,
    turned,
    upright,
)


def sofa(rng: np.random.Generator, style: int) -> Furniture:
    """A sofa of 1-4 seats: 0 block arms, 1 without arms, 2 slim on legs, 3 a corner."""
    low, high = {0: (2, 5), 1: (1, 4), 2: (2, 5), 3: (3, 4)}[style]
    seats = int(rng.integers(low, high))
    each = draw(rng, 0.6, 0.72) if seats > 1 else draw(rng, 0.7, 0.8)
    d, h, back = draw(rng, 0.47, 0.52), draw(rng, 0.4, 0.44), draw(rng, 0.76, 0.86)
    arm = (draw(rng, 0.15, 0.22), 0.0, draw(rng, 0.08, 0.1), draw(rng, 0.14, 0.18))[style]
    x, foot = seats * each / 2, 0.14 if style == 2 else 0.05
    sides = {0: (-1, 1), 1: (), 2: (-1, 1), 3: (-1,)}[style]
    left, right = -x - (arm if -1 in sides else 0), x + (arm if 1 in sides else 0)
    parts = [block((left + 0.01, right - 0.01), (foot, h - 0.14), (-0.24, d - 0.03), 0.01)]
    parts += _cushions(seats, each, (foot, h, back), d)
    top = h + (0.2 if style == 0 else 0.17)
    for inside, outside in (sorted((s * x, s * (x + arm))) for s in sides):
        parts.append(block((inside, outside), (foot, top), (-0.24, d - 0.01), 0.03))
    front = d
    if style == 3:
        front = d + draw(rng, 0.5, 0.75)
        parts.append(block((x - each, x), (h - 0.17, h), (0.1, front), 0.03))
        parts.append(block((x - each + 0.01, x - 0.01), (foot, h - 0.14), (0.1, front - 0.03)))
    for i, ahead in ((left + 0.07, d), (right - 0.07, front)):
        feet = ((i, -0.18), (i, ahead - 0.1))
        parts += [rod((i, 0, k), (i, foot + 0.03, k), (0.022, 0.028), 8) for i, k in feet]
    usable = (-x, x - each if style == 3 else x)
    return finish("sofa", style, parts, Seat(h, usable, (0.0, d), back))


def _cushions(seats: int, each: float, heights: tuple[float, float, float], d: float) -> list[Part]:
    foot, h, back = heights
    x = seats * each / 2
    parts = [block((-x - 0.005, x + 0.005), (foot, back - 0.05), (-0.25, -0.14), 0.02)]
    for k in range(seats):
        span = (-x + k * each - 0.003, -x + (k + 1) * each + 0.003)
        parts.append(block(span, (h - 0.16, h), (-0.15, d), 0.02))
        parts.append(tilted(block(span, (h - 0.05, back), (-0.16, 0), 0.03), 8, h, 0))
    return parts


def bed(rng: np.random.Generator, style: int, pillows: int = 1) -> Furniture:
    """A bed for one or two: 0 box with headboard, 1 head and foot boards, 2 low platform.

    For detected beds only: 3 planks on legs, 4 head and foot boards of one piece with high legs.
    """
    width = draw(rng, 0.9, 1.05) if pillows == 1 else draw(rng, 1.4, 1.8)
    length, h = draw(rng, 1.96, 2.05), draw(rng, 0.44, 0.52)
    x, z = width / 2, length / 2
    if style == 2:
        h = draw(rng, 0.38, 0.42)
    under, edge = (0.0, 0.02) if style == 0 else (h - 0.26, 0.04)
    mattress = block((-x, x), (h - 0.2, h), (-z, z), 0.03)
    frame = block((-x - edge, x + edge), (under, h - 0.14), (-z - edge, z + edge), 0.008)
    parts = [mattress, frame]
    if style >= 3:
        length = draw(rng, 1.8, 2.05)
        return _open_bed((width, h, length), style == 4, draw(rng, 0.8, 1.1), pillows)
    if style > 0:
        parts += posts(pair(x - 0.04), pair(z - 0.04), (0, h - 0.15), 0.04)
    board = draw(rng, 0.95, 1.15)
    behind = (-z - edge - 0.05, -z - edge + 0.03)
    if style == 0:
        parts.append(block((-x - edge, x + edge), (0, board), behind, 0.012))
    if style == 1:
        parts += _slats((-x - edge, x + edge), (h - 0.15, board), behind)
        ahead = (z + edge - 0.03, z + edge + 0.04)
        parts += _slats((-x - edge, x + edge), (h - 0.15, h + 0.14), ahead)
    parts += _pillows(x, z, h, pillows)
    return finish("bed", style, parts, Seat(h, (-x, x), (-z, z)), top=h)


def _open_bed(
    size: tuple[float, float, float], boards: bool, high: float, pillows: int
) -> Furniture:
    """A thin mattress on a thin frame, with nothing but legs below."""
    width, h, length = size
    x, z = width / 2, length / 2
    parts = [block((-x, x), (h - 0.1, h), (-z, z), 0.03)]
    parts.append(block((-x, x), (h - 0.18, h - 0.08), (-z, z), 0.008))
    parts += posts(pair(x - 0.04), pair(z - 0.04), (0, h - 0.1), 0.035)
    for k, top in ((-z, high), (z, 0.85 * high)) if boards else ():
        parts.append(block((-x, x), (h - 0.15, top), (k - 0.03, k + 0.03), 0.01))
        parts += posts(pair(x - 0.03), (k, k), (0, top), 0.03)
    parts += _pillows(x, z, h, pillows)
    return finish("bed", 3 + boards, parts, Seat(h, (-x, x), (-z, z)), top=h)


def _pillows(x: float, z: float, h: float, count: int) -> list[Part]:
    centres = [0.0] if count == 1 else [-x / 2, x / 2]
    half = min(0.36, x / count - 0.04)
    parts: list[Part] = []
    for c in centres:
        low = block((c - half, c + half), (h - 0.02, h + 0.03), (-z + 0.04, -z + 0.42))
        high = block((c - half + 0.06, c + half - 0.06), (h, h + 0.075), (-z + 0.1, -z + 0.36))
        parts.append(np.concatenate([low, high]))
    return parts


def _slats(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> list[Part]:
    rail = block(x, (y[1] - 0.06, y[1]), z, 0.006)
    at, inner = np.linspace(x[0] + 0.04, x[1] - 0.04, 6), (z[0] + 0.01, z[1] - 0.01)
    bars = upright(at, 0.03, (y[0] - 0.1, y[1] - 0.02), inner)
    return [rail, *bars, *upright((x[0] + 0.035, x[1] - 0.035), 0.035, (0, y[1]), z)]


def chair(rng: np.random.Generator, style: int) -> Furniture:
    """A chair without arms: 0 panel back, 1 ladder back, 2 side frames, 3 spindles."""
    w, d = draw(rng, 0.42, 0.48), draw(rng, 0.41, 0.46)
    h, back = draw(rng, 0.43, 0.46), draw(rng, 0.84, 0.98)
    x, z = w / 2, d / 2
    lean, behind = draw(rng, 4, 9), z - 0.045
    seat = block((-x, x), (h - 0.045, h), (-z, z), 0.008)
    parts = [seat, *(_CHAIR_LEGS[style](x, z, h))]
    parts += [tilted(p, lean, h, -behind) for p in _CHAIR_BACKS[style](x, h, back, -behind)]
    return finish("chair", style, parts, Seat(h, (-x, x), (-behind + 0.01, z), back))


def _ladder_back(x: float, h: float, back: float, z: float) -> list[Part]:
    behind, inner = z - 0.018, pair(x - 0.02)
    bars = [rod((s, h - 0.04, behind), (s, back, behind), (0.018, 0.018)) for s in inner]
    rungs = np.linspace(h + 0.16, back - 0.04, 3)
    return bars + [block(inner, (y - 0.03, y + 0.03), (z - 0.026, z - 0.004)) for y in rungs]


def _low_back(x: float, h: float, back: float, z: float) -> list[Part]:
    low = h + 0.12
    bars = upright(pair(0.8 * x), 0.02, (h - 0.04, back - 0.02), (z - 0.03, z - 0.004))
    return [*bars, block((-x, x), (low, back), (z - 0.04, z), 0.012)]


def _spindle_back(x: float, h: float, back: float, z: float) -> list[Part]:
    xs, k = np.linspace(-x + 0.03, x - 0.03, 6), z - 0.018
    spindles = [rod((s, h - 0.03, k), (s, back - 0.02, k), (0.011, 0.009), 8) for s in xs]
    return [*spindles, block((-x, x), (back - 0.07, back), (z - 0.034, z - 0.002), 0.008)]


def _round_legs(x: float, z: float, h: float) -> list[Part]:
    left, right = pair(x - 0.03)
    rungs = [rod((left, 0.2, k), (right, 0.2, k), (0.011, 0.011), 8) for k in pair(z - 0.03)]
    return [*legs(x - 0.035, z - 0.035, h - 0.02, 0.02, 0.004), *rungs]


def _side_frames(x: float, z: float, h: float) -> list[Part]:
    parts: list[Part] = []
    for s in (-1, 1):
        side = (s * (x - 0.02) - 0.018, s * (x - 0.02) + 0.018)
        parts.append(block(side, (0, 0.035), (-z + 0.01, z - 0.01)))
        parts += crosswise(side, (0.01, h - 0.02), pair(z - 0.03), 0.018)
    return parts


Legs = Callable[[float, float, float], list[Part]]
_CHAIR_LEGS: tuple[Legs, ...] = (
    lambda x, z, h: legs(x - 0.03, z - 0.03, h - 0.02, 0.028),
    _round_legs,
    _side_frames,
    lambda x, z, h: legs(x - 0.06, z - 0.06, h - 0.02, 0.02, 0.04),
)
_CHAIR_BACKS: tuple[Callable[[float, float, float, float], list[Part]], ...] = (
    lambda x, h, back, z: [block((-x, x), (h - 0.04, back), (z - 0.03, z), 0.008)],
    _ladder_back,
    _low_back,
    _spindle_back,
)


def armchair(rng: np.random.Generator, style: int) -> Furniture:
    """A wide chair with arms: 0 club, 1 high back on legs, 2 wooden frame with cushions."""
    inner, d = draw(rng, 0.54, 0.62), draw(rng, 0.46, 0.51)
    h, x = draw(rng, 0.41, 0.45), inner / 2
    back, arm = (draw(rng, 0.78, 0.88), draw(rng, 0.12, 0.17))
    if style == 1:
        back, arm = back + 0.2, 0.09
    if style == 2:
        arm = 0.05
    foot = 0.05 if style == 0 else 0.16
    cushion = block((-x - 0.01, x + 0.01), (max(foot, h - 0.2), h), (-0.02, d), 0.03)
    rest = tilted(block((-x - 0.01, x + 0.01), (h - 0.12, back), (-0.17, 0), 0.03), 9, h, 0)
    parts = [cushion, rest]
    for s in (-1, 1):
        parts += _arm_seats(style, s, x, arm, (h, d, foot))
    span = (-x - arm + 0.03, x + arm - 0.03)
    base = block(span, (foot, h - 0.1), (-0.17, d - 0.02), 0.01)
    thin = 0.03 if style == 0 else 0.022
    feet = [(i, k) for i in (span[0] + 0.04, span[1] - 0.04) for k in (-0.12, d - 0.07)]
    if style < 2:
        parts += [base, *(rod((i, 0, k), (i, foot + 0.03, k), (thin, thin), 8) for i, k in feet)]
    else:
        parts.append(block((-x - 0.02, x + 0.02), (h - 0.17, h - 0.1), (-0.1, d - 0.02)))
    return finish("armchair", style, parts, Seat(h, (-x, x), (0.0, d), back))


def _arm_seats(
    style: int, side: int, x: float, arm: float, rest: tuple[float, float, float]
) -> list[Part]:
    h, d, foot = rest
    inside, outside = side * x, side * (x + arm)
    span = (min(inside, outside), max(inside, outside))
    if style < 2:
        return [block(span, (foot, h + 0.19), (-0.15, d - 0.02), 0.025)]
    top = block((span[0] - 0.015, span[1] + 0.015), (h + 0.17, h + 0.2), (-0.16, d + 0.03), 0.006)
    bars = crosswise(span, (0, h + 0.18), (-0.12, d - 0.05), 0.025)
    return [top, *bars, block(span, (h - 0.17, h - 0.12), (-0.12, d - 0.05))]


def office_chair(rng: np.random.Generator, style: int) -> Furniture:
    """A chair on a column and a five-armed foot: 0 without arms, 1 with arms and a high back."""
    w, d, h = draw(rng, 0.46, 0.5), draw(rng, 0.44, 0.48), draw(rng, 0.44, 0.48)
    back = h + (0.48 if style == 0 else 0.66)
    x, z = w / 2, d / 2
    column = [disc((0, 0), (0.07, h - 0.03), 0.028, 12), disc((0, 0), (0.06, 0.14), 0.05, 16)]
    parts = [block((-x, x), (h - 0.07, h), (-z, z), 0.03), *column]
    for k in range(5):
        spoke = block((-0.022, 0.022), (0.06, 0.1), (0, 0.29))
        caster = rod((-0.025, 0.032, 0.27), (0.025, 0.032, 0.27), (0.032, 0.032), 12)
        post = block((-0.012, 0.012), (0.03, 0.08), (0.258, 0.282))
        parts += [turned(p, 72 * k + 36) for p in (spoke, caster, post)]
    behind = -z + 0.03
    low = h + (0.14 if style == 0 else 0.02)
    rest = block((-x + 0.02, x - 0.02), (low, back), (behind - 0.05, behind), 0.02)
    spine = block((-0.04, 0.04), (h - 0.06, low + 0.1), (behind - 0.075, behind - 0.03))
    parts += [tilted(p, 7, h, behind) for p in (rest, spine)]
    if style == 1:
        for s in (-x - 0.005, x + 0.005):
            parts.append(block((s - 0.025, s + 0.025), (h + 0.19, h + 0.22), (-0.16, 0.12), 0.008))
            parts.append(block((s - 0.018, s + 0.018), (h - 0.055, h + 0.2), (-0.05, 0.01)))
    return finish("office chair", style, parts, Seat(h, (-x, x), (behind + 0.01, z), back))


def stool(rng: np.random.Generator, style: int) -> Furniture:
    """A seat without a back: 0 round on splayed legs, 1 square, 2 a pouf."""
    r, h = draw(rng, 0.18, 0.22), draw(rng, 0.43, 0.47)
    if style == 0:
        parts = [disc((0, 0), (h - 0.04, h), r), *legs(0.1, 0.1, h - 0.02, 0.02, 0.05)]
    elif style == 1:
        parts = [block((-r, r), (h - 0.05, h), (-r, r), 0.01)]
        parts += legs(r - 0.03, r - 0.03, h - 0.02, 0.025)
        parts += crosswise(pair(r - 0.02), (0.13, 0.16), pair(r - 0.03), 0.012)
    else:
        r += 0.04
        cuts = ((0, 0.03), (0.03, 0), (h - 0.05, 0), (h - 0.01, 0.03))
        parts = [np.concatenate([disc((0, 0), (y, y + 0.01), r - cut, 24) for y, cut in cuts])]
    reach = 0.8 * r
    return finish("stool", style, parts, Seat(h, (-reach, reach), (-r, r)))


def bench(rng: np.random.Generator, style: int) -> Furniture:
    """A long seat without a back: 0 on panels, 1 on legs, slatted, 2 padded."""
    w, d, h = draw(rng, 1.0, 1.4), draw(rng, 0.36, 0.42), draw(rng, 0.43, 0.47)
    x, z = w / 2, d / 2
    if style == 0:
        parts = [block((-x, x), (h - 0.045, h), (-z, z), 0.006)]
        parts += upright(pair(x - 0.1), 0.02, (0, h - 0.02), pair(z - 0.02))
        parts.append(block((-x + 0.1, x - 0.1), (h - 0.14, h - 0.03), (-0.012, 0.012)))
    elif style == 1:
        edges = np.linspace(-z, z, 6)
        parts = [block((-x, x), (h - 0.03, h), (a, b - 0.008)) for a, b in pairwise(edges)]
        parts += upright(pair(x - 0.12), 0.03, (h - 0.07, h - 0.02), (-z + 0.01, z - 0.02))
        parts += posts(pair(x - 0.12), (-z + 0.05, z - 0.06), (0, h - 0.03), 0.025)
    else:
        parts = [block((-x, x), (h - 0.12, h), (-z, z), 0.025)]
        parts += legs(x - 0.08, z - 0.06, h - 0.1, 0.022, 0.03)
    return finish("bench", style, parts, Seat(h, (-x, x), (-z, z)))
