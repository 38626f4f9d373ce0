"""Tables, shelves, cabinets and lamps: what stands around."""

from itertools import pairwise

import numpy as np

from mover.furniture.pieces import (
    Furniture,
    Part,
    block,
    crosswise,
    disc,
    draw,
    finish,
    legs,
    pair,
    posts,
    rod,
    turned,
    upright,
)


def table(rng: np.random.Generator, style: int) -> Furniture:
    """A dining table: 0 four legs, 1 trestles, 2 round on a column, 3 round on legs."""
    w, d, h = draw(rng, 1.1, 1.7), draw(rng, 0.75, 0.92), draw(rng, 0.72, 0.77)
    x, z, r = w / 2, d / 2, draw(rng, 0.45, 0.6)
    if style == 0:
        parts = [block((-x, x), (h - 0.035, h), (-z, z), 0.006)]
        parts += legs(x - 0.06, z - 0.06, h - 0.01, 0.045)
        parts.append(block((-x + 0.08, x - 0.08), (h - 0.11, h - 0.02), (-z + 0.06, z - 0.06)))
    elif style == 1:
        parts = [block((-x, x), (h - 0.04, h), (-z, z), 0.008)]
        parts.append(block(pair(x - 0.25), (0.3, 0.36), (-0.03, 0.03)))
        for s in pair(x - 0.25):
            parts += upright([s], 0.035, (0.03, h - 0.02), (-0.06, 0.06))
            parts += upright([s], 0.04, (0, 0.06), pair(z - 0.1))
            parts += upright([s], 0.04, (h - 0.09, h - 0.03), pair(z - 0.1))
    elif style == 2:
        foot = [disc((0, 0), (0.03, h - 0.02), 0.05, 16), disc((0, 0), (0, 0.04), 0.3, 32)]
        parts = [disc((0, 0), (h - 0.035, h), r, 40), *foot]
    else:
        parts = [disc((0, 0), (h - 0.035, h), r, 40), *legs(0.5 * r, 0.5 * r, h - 0.02, 0.028, 0.1)]
    return finish("table", style, parts, top=h)


def desk(rng: np.random.Generator, style: int) -> Furniture:
    """A desk, drawers and knee room towards +z: 0 drawers at one side, 1 panels, 2 on legs."""
    w, d, h = draw(rng, 1.1, 1.5), draw(rng, 0.6, 0.75), draw(rng, 0.72, 0.76)
    x, z = w / 2, d / 2
    parts = [block((-x, x), (h - 0.03, h), (-z, z), 0.005)]
    if style == 0:
        parts += [block((x - 0.42, x - 0.02), (0.04, h - 0.01), (-z + 0.02, z - 0.03))]
        front, feet = (z - 0.04, z - 0.02), (-z + 0.06, z - 0.08)
        parts += [block((x - 0.4, x - 0.04), (y, y + 0.18), front) for y in (0.07, 0.28, 0.49)]
        parts += crosswise((x - 0.4, x - 0.36), (0, 0.06), feet, 0.02)
        parts += crosswise((x - 0.08, x - 0.04), (0, 0.06), feet, 0.02)
        parts += crosswise((-x + 0.02, -x + 0.07), (0, h - 0.01), (-z + 0.05, z - 0.06), 0.025)
    elif style == 1:
        parts += upright(pair(x - 0.04), 0.015, (0, h - 0.01), pair(z - 0.02))
        parts.append(block((-x + 0.04, x - 0.04), (0.35, h - 0.01), (-z + 0.05, -z + 0.07)))
    else:
        parts += legs(x - 0.08, z - 0.08, h - 0.01, 0.025, 0.05)
        parts.append(block(pair(x - 0.06), (h - 0.12, h - 0.02), (-z + 0.06, z - 0.1)))
    return finish("desk", style, parts, top=h)


def coffee_table(rng: np.random.Generator, style: int) -> Furniture:
    """A low table: 0 four legs and a shelf, 1 round, 2 a block on a plinth."""
    w, d, h = draw(rng, 0.85, 1.2), draw(rng, 0.5, 0.62), draw(rng, 0.36, 0.44)
    x, z, r = w / 2, d / 2, draw(rng, 0.36, 0.45)
    if style == 0:
        parts = [block((-x, x), (h - 0.04, h), (-z, z), 0.006)]
        parts += legs(x - 0.05, z - 0.05, h - 0.02, 0.035)
        parts.append(block((-x + 0.04, x - 0.04), (0.12, 0.15), (-z + 0.04, z - 0.04)))
    elif style == 1:
        foot = rod((0.24, 0, 0), (0.14, h - 0.02, 0), (0.015, 0.022))
        feet = [turned(foot, 120 * k + 30) for k in range(3)]
        parts = [disc((0, 0), (h - 0.03, h), r, 36), *feet]
    else:
        plinth = block(pair(x - 0.06), (0, 0.08), pair(z - 0.06))
        parts = [block((-x, x), (0.06, h), (-z, z), 0.01), plinth]
    return finish("coffee table", style, parts, top=h)


def shelf(rng: np.random.Generator, style: int) -> Furniture:
    """A bookshelf: 0 closed back, 1 open frame, 2 with books, 3 low and wide."""
    w, d, h = draw(rng, 0.75, 1.0), draw(rng, 0.27, 0.36), draw(rng, 1.5, 1.9)
    if style == 3:
        w, h = draw(rng, 1.1, 1.5), draw(rng, 0.75, 0.95)
    x, z = w / 2, d / 2
    boards = np.linspace(0.05, h - 0.0125, max(3, round(h / 0.36) + 1))
    parts = [block((-x, x), (y - 0.0125, y + 0.0125), (-z, z)) for y in boards]
    if style == 1:
        parts += posts(pair(x - 0.018), pair(z - 0.018), (0, h), 0.018)
    else:
        sides = [*pair(x - 0.012), *([0.0] if style == 3 else [])]
        parts += upright(sides, 0.012, (0, h), (-z, z))
        parts.append(block((-x, x), (0.03, h), (-z, -z + 0.012)))
    if style == 2:
        parts += _books(rng, x, z, boards)
    return finish("shelf", style, parts, top=h)


def _books(rng: np.random.Generator, x: float, z: float, boards: np.ndarray) -> list[Part]:
    parts: list[Part] = []
    for low, high in pairwise(boards):
        at = -x + 0.02
        while at < x - 0.3:
            wide, tall = draw(rng, 0.08, 0.25), draw(rng, 0.5, 0.8) * (high - low)
            parts.append(block((at, at + wide), (low, low + tall), (-z, z - draw(rng, 0.04, 0.09))))
            at += wide + draw(rng, 0.0, 0.12)
    return parts


def cabinet(rng: np.random.Generator, style: int) -> Furniture:
    """A sideboard or chest: 0 doors on a plinth, 1 drawers, 2 long and low on legs."""
    w, d, h = draw(rng, 0.8, 1.2), draw(rng, 0.4, 0.48), draw(rng, 0.8, 1.0)
    if style == 2:
        w, h = draw(rng, 1.3, 1.8), draw(rng, 0.6, 0.75)
    foot = 0.16 if style == 2 else 0.05
    fronts = {0: (2, 1), 1: (1, 4), 2: (3, 1)}[style]
    parts = _cupboard(w, d, (foot, h), fronts)
    x, z = w / 2, d / 2
    if style == 2:
        parts += legs(x - 0.08, z - 0.07, foot + 0.02, 0.022, 0.03)
    else:
        parts.append(block((-x + 0.02, x - 0.02), (0, foot + 0.01), (-z + 0.01, z - 0.05)))
    parts.append(block((-x - 0.01, x + 0.01), (h - 0.025, h), (-z, z + 0.02), 0.004))
    return finish("cabinet", style, parts, top=h)


def wardrobe(rng: np.random.Generator, style: int) -> Furniture:
    """A tall cupboard for clothes: 0 two doors, 1 three doors and drawers below."""
    w, d, h = draw(rng, 0.95, 1.1), draw(rng, 0.55, 0.62), draw(rng, 1.85, 2.1)
    if style == 1:
        w = draw(rng, 1.3, 1.6)
    parts = _cupboard(w, d, (0.06 if style == 0 else 0.3, h), (2 + style, 1))
    x, z = w / 2, d / 2
    parts.append(block((-x + 0.01, x - 0.01), (0, 0.08), (-z + 0.01, z - 0.04)))
    if style == 1:
        parts += _cupboard(w, d, (0.06, 0.31), (2, 1))
    parts.append(block((-x - 0.015, x + 0.015), (h - 0.03, h + 0.01), (-z, z + 0.03), 0.005))
    return finish("wardrobe", style, parts, top=h + 0.01)


def nightstand(rng: np.random.Generator, style: int) -> Furniture:
    """A small cupboard beside a bed: 0 drawers, 1 open on legs, 2 round."""
    w, d, h = draw(rng, 0.4, 0.5), draw(rng, 0.36, 0.42), draw(rng, 0.45, 0.56)
    x, z = w / 2, d / 2
    if style == 0:
        plinth = block(pair(x - 0.02), (0, 0.05), (-z + 0.02, z - 0.04))
        parts = [*_cupboard(w, d, (0.04, h), (1, 2)), plinth]
    elif style == 1:
        parts = [block((-x, x), (h - 0.03, h), (-z, z))]
        parts += legs(x - 0.025, z - 0.025, h - 0.01, 0.022)
        shelves = ((h - 0.16, h - 0.02), (0.12, 0.14))
        parts += [block(pair(x - 0.01), y, pair(z - 0.01)) for y in shelves]
    else:
        r = x - 0.02
        column = disc((0, 0), (0.02, h - 0.02), 0.03, 12)
        parts = [disc((0, 0), (h - 0.03, h), r), column, disc((0, 0), (0, 0.03), 0.8 * r)]
    return finish("nightstand", style, parts, top=h)


def _cupboard(w: float, d: float, y: tuple[float, float], fronts: tuple[int, int]) -> list[Part]:
    """A body with a grid of (columns, rows) fronts and a handle on each."""
    x, z = w / 2, d / 2
    parts = [block((-x, x), y, (-z, z - 0.02))]
    xs, ys = np.linspace(-x, x, fronts[0] + 1), np.linspace(y[0], y[1] - 0.02, fronts[1] + 1)
    for a, b in pairwise(xs):
        for low, high in pairwise(ys):
            parts.append(block((a + 0.006, b - 0.006), (low + 0.006, high - 0.006), (z - 0.03, z)))
            parts.append(_handle((a, b), (low, high), z))
    return parts


def _handle(x: tuple[float, float], y: tuple[float, float], z: float) -> Part:
    if y[1] - y[0] > 0.4:
        at = x[1] - 0.05
        mid = (y[0] + y[1]) / 2
        return block((at - 0.008, at + 0.008), (mid - 0.09, mid + 0.09), (z - 0.01, z + 0.02))
    mid, high = (x[0] + x[1]) / 2, y[1] - 0.06
    return block((mid - 0.07, mid + 0.07), (high - 0.008, high + 0.008), (z - 0.01, z + 0.02))


def lamp(rng: np.random.Generator, style: int) -> Furniture:
    """A floor lamp: 0 cone shade, 1 tripod with a drum, 2 an uplight."""
    h, r = draw(rng, 1.45, 1.7), draw(rng, 0.17, 0.22)
    if style == 1:
        foot = rod((0.28, 0, 0), (0.02, h - 0.28, 0), (0.012, 0.014), 8)
        drum = disc((0, 0), (h - 0.3, h), 1.15 * r, 28)
        feet = [turned(foot, 120 * k) for k in range(3)]
        parts = [*feet, disc((0, 0), (h - 0.32, h - 0.2), 0.02, 8), drum]
    else:
        shade = rod((0, h - 0.26, 0), (0, h, 0), (r, 0.55 * r), 28)
        if style == 2:
            shade = rod((0, h - 0.14, 0), (0, h, 0), (0.06, r), 28)
        stand = [disc((0, 0), (0, 0.025), 0.14, 28), disc((0, 0), (0.02, h - 0.1), 0.013, 10)]
        parts = [*stand, shade]
    return finish("floor lamp", style, parts)
