"""Sofas and beds: what one sits, leans and lies on."""

import numpy as np

from .pieces import Furniture, Part, Seat, block, draw, finish, post, rod, tilted


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
    parts += [_arm(s * x, s * (x + arm), (foot, top), d) for s in sides]
    front = d
    if style == 3:
        front = d + draw(rng, 0.5, 0.75)
        parts.append(block((x - each, x), (h - 0.17, h), (0.1, front), 0.03))
        parts.append(block((x - each + 0.01, x - 0.01), (foot, h - 0.14), (0.1, front - 0.03)))
    feet = [
        (left + 0.07, -0.18),
        (left + 0.07, d - 0.1),
        (right - 0.07, -0.18),
        (right - 0.07, front - 0.1),
    ]
    parts += [rod((i, 0, k), (i, foot + 0.03, k), (0.022, 0.028), 8) for i, k in feet]
    usable = (-x, x - each if style == 3 else x)
    return finish("sofa", style, parts, Seat(h, usable, (0.0, d), back))


def _arm(inside: float, outside: float, y: tuple[float, float], d: float) -> Part:
    x = (min(inside, outside), max(inside, outside))
    return block(x, y, (-0.24, d - 0.01), 0.03)


def _cushions(seats: int, each: float, heights: tuple[float, float, float], d: float) -> list[Part]:
    foot, h, back = heights
    x = seats * each / 2
    parts = [block((-x - 0.005, x + 0.005), (foot, back - 0.05), (-0.25, -0.14), 0.02)]
    for k in range(seats):
        span = (-x + k * each - 0.003, -x + (k + 1) * each + 0.003)
        parts.append(block(span, (h - 0.16, h), (-0.15, d), 0.02))
        parts.append(tilted(block(span, (h - 0.05, back), (-0.16, 0), 0.03), 8, h, 0))
    return parts


def single_bed(rng: np.random.Generator, style: int) -> Furniture:
    """A bed for one: see `_bed`."""
    return _bed("bed", rng, style, draw(rng, 0.9, 1.05), 1)


def double_bed(rng: np.random.Generator, style: int) -> Furniture:
    """A bed for two: see `_bed`."""
    return _bed("bed", rng, style, draw(rng, 1.4, 1.8), 2)


def _bed(
    category: str, rng: np.random.Generator, style: int, width: float, pillows: int
) -> Furniture:
    """0 box with headboard, 1 frame with head and foot boards, 2 low platform."""
    length, h = draw(rng, 1.96, 2.05), draw(rng, 0.44, 0.52)
    x, z = width / 2, length / 2
    if style == 2:
        h = draw(rng, 0.38, 0.42)
    under, edge = (0.0, 0.02) if style == 0 else (h - 0.26, 0.04)
    mattress = block((-x, x), (h - 0.2, h), (-z, z), 0.03)
    frame = block((-x - edge, x + edge), (under, h - 0.14), (-z - edge, z + edge), 0.008)
    parts = [mattress, frame]
    if style > 0:
        parts += [
            post(i, k, (0, h - 0.15), 0.04)
            for i in (-x + 0.04, x - 0.04)
            for k in (-z + 0.04, z - 0.04)
        ]
    board = draw(rng, 0.95, 1.15)
    behind = (-z - edge - 0.05, -z - edge + 0.03)
    if style == 0:
        parts.append(block((-x - edge, x + edge), (0, board), behind, 0.012))
    if style == 1:
        parts += _slats((-x - edge, x + edge), (h - 0.15, board), behind)
        parts += _slats(
            (-x - edge, x + edge), (h - 0.15, h + 0.14), (z + edge - 0.03, z + edge + 0.04)
        )
    parts += _pillows(x, z, h, pillows)
    return finish(category, style, parts, Seat(h, (-x, x), (-z, z)), top=h)


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
    bars = [
        block((c - 0.03, c + 0.03), (y[0] - 0.1, y[1] - 0.02), (z[0] + 0.01, z[1] - 0.01))
        for c in np.linspace(x[0] + 0.04, x[1] - 0.04, 6)
    ]
    posts = [block((s - 0.035, s + 0.035), (0, y[1]), z) for s in (x[0] + 0.035, x[1] - 0.035)]
    return [rail, *bars, *posts]
