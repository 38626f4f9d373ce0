"""The piece of the library that is most like a box of a class."""

from functools import cache

import numpy as np

from ..types import Mesh
from .library import PIECES, STYLES, canonical, make_piece
from .pieces import Furniture, block, finish

SEEDS = 6  # sizes that are tried of each design
Size = tuple[float, float, float]


@cache
def catalogue(category: str) -> tuple[Furniture, ...]:
    """All designs of a class in several sizes; none where the library lacks the class."""
    kind = canonical(category)
    return tuple(
        make_piece(name, np.random.default_rng(seed), style)
        for name in PIECES
        if canonical(name) == kind
        for style in range(STYLES[name])
        for seed in range(SEEDS)
    )


def choose_piece(category: str, size: Size) -> Mesh:
    """The mesh whose proportions are nearest to those of a box; a plain box for unknown classes.

    Nearest is the smallest sum of squared logarithms of the ratios of width, height and depth,
    so that the mesh is stretched as little as possible when it fills the box.

    Args:
        category: Free text.
        size: Width (x), height (y) and depth (z) of the box [m].
    """
    pieces = catalogue(canonical(category))
    if not pieces:
        low = (-size[0] / 2, 0.0, -size[2] / 2)
        high = (size[0] / 2, size[1], size[2] / 2)
        x, y, z = zip(low, high, strict=True)
        return finish(canonical(category), 0, [block(x, y, z)], top=size[1]).mesh
    stretch = [np.log(np.array(size) / np.array(piece.size)) for piece in pieces]
    return pieces[int(np.argmin([float((s * s).sum()) for s in stretch]))].mesh
