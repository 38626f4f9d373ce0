"""The piece of the library that is most like a box of a class."""

from collections.abc import Callable
from functools import cache

import numpy as np

from mover.core.types import Mesh
from mover.furniture import seats, storage
from mover.furniture import seats as sofas
from mover.furniture.pieces import Furniture, block, finish

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
    """
    pieces = catalogue(canonical(category))
    if not pieces:
        low = (-size[0] / 2, 0.0, -size[2] / 2)
        high = (size[0] / 2, size[1], size[2] / 2)
        x, y, z = zip(low, high, strict=True)
        return finish(canonical(category), 0, [block(x, y, z)], top=size[1]).mesh
    stretch = [np.log(np.array(size) / np.array(piece.size)) for piece in pieces]
    return pieces[int(np.argmin([float((s * s).sum()) for s in stretch]))].mesh


# Which pieces there are: names, synonyms, sizes, and what people do with them.


PIECES: dict[str, Callable[[np.random.Generator, int], Furniture]] = {
    "chair": seats.chair,
    "armchair": seats.armchair,
    "office chair": seats.office_chair,
    "stool": seats.stool,
    "bench": seats.bench,
    "sofa": sofas.sofa,
    "single bed": sofas.single_bed,
    "double bed": sofas.double_bed,
    "table": storage.table,
    "desk": storage.desk,
    "coffee table": storage.coffee_table,
    "shelf": storage.shelf,
    "cabinet": storage.cabinet,
    "wardrobe": storage.wardrobe,
    "nightstand": storage.nightstand,
    "floor lamp": storage.lamp,
}
"""A function for each piece: (random numbers, style) to a shape of new size."""

STYLES: dict[str, int] = {
    "chair": 4, "armchair": 3, "office chair": 2, "stool": 3, "bench": 3, "sofa": 4,
    "single bed": 3, "double bed": 3, "table": 4, "desk": 3, "coffee table": 3, "shelf": 4,
    "cabinet": 3, "wardrobe": 2, "nightstand": 3, "floor lamp": 3,
}  # fmt: skip
"""Number of designs of each piece."""

SIZES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "chair": ((0.40, 0.62), (0.80, 1.02), (0.40, 0.66)),
    "armchair": ((0.60, 1.00), (0.72, 1.12), (0.65, 0.95)),
    "office chair": ((0.50, 0.72), (0.88, 1.20), (0.48, 0.70)),
    "stool": ((0.30, 0.55), (0.40, 0.50), (0.30, 0.55)),
    "bench": ((0.90, 1.60), (0.40, 0.50), (0.32, 0.50)),
    "sofa": ((0.65, 3.40), (0.70, 0.92), (0.70, 1.60)),
    "bed": ((0.85, 1.95), (0.42, 1.20), (1.90, 2.25)),
    "table": ((0.80, 1.80), (0.68, 0.80), (0.70, 1.25)),
    "desk": ((1.00, 1.60), (0.68, 0.80), (0.55, 0.80)),
    "coffee table": ((0.60, 1.30), (0.32, 0.48), (0.48, 0.95)),
    "shelf": ((0.70, 1.55), (0.70, 1.95), (0.25, 0.40)),
    "cabinet": ((0.75, 1.90), (0.55, 1.05), (0.38, 0.55)),
    "wardrobe": ((0.90, 1.70), (1.80, 2.20), (0.52, 0.70)),
    "nightstand": ((0.36, 0.55), (0.42, 0.60), (0.34, 0.55)),
    "floor lamp": ((0.26, 0.65), (1.40, 1.75), (0.26, 0.65)),
}
"""Smallest and largest width (x), height (y) and depth (z) of each class [m]."""

Usual = tuple[float, float] | None
STANDARD: dict[str, tuple[Usual, Usual, Usual]] = {
    "chair": ((0.48, 0.15), (0.90, 0.10), (0.52, 0.15)),
    "armchair": ((0.80, 0.18), (0.90, 0.15), (0.82, 0.12)),
    "office chair": ((0.62, 0.12), (1.00, 0.12), (0.62, 0.12)),
    "stool": (None, (0.46, 0.08), None),
    "sofa": (None, (0.82, 0.10), (0.90, 0.15)),
    "bed": (None, None, (2.05, 0.06)),
    "table": (None, (0.74, 0.04), None),
    "desk": (None, (0.74, 0.04), (0.68, 0.12)),
    "coffee table": (None, (0.42, 0.15), None),
    "shelf": (None, None, (0.32, 0.18)),
    "cabinet": (None, None, (0.45, 0.15)),
    "wardrobe": (None, (2.00, 0.08), (0.60, 0.10)),
    "nightstand": ((0.45, 0.18), (0.52, 0.15), (0.42, 0.18)),
    "floor lamp": (None, (1.55, 0.12), None),
}
"""Width (x), height (y) and depth (z) as makers of furniture keep to them [m], with the standard
deviation of the logarithm; None: there is no such standard. Tables and desks are .70-.78 m high,
seats .40-.50 m for the sake of the body, beds as long as mattresses, wardrobes as deep as hangers.
"""

SYNONYMS: dict[str, str] = {
    "couch": "sofa", "loveseat": "sofa", "settee": "sofa", "sectional": "sofa",
    "corner sofa": "sofa",
    "single bed": "bed", "double bed": "bed", "bunk bed": "bed",
    "dining table": "table", "kitchen table": "table", "round table": "table",
    "writing desk": "desk", "computer desk": "desk", "office desk": "desk",
    "tea table": "coffee table", "side table": "coffee table", "end table": "coffee table",
    "bookshelf": "shelf", "bookcase": "shelf", "bookshelves": "shelf", "shelves": "shelf",
    "cupboard": "cabinet", "sideboard": "cabinet", "dresser": "cabinet",
    "chest of drawers": "cabinet",
    "drawers": "cabinet", "tv stand": "cabinet", "closet": "wardrobe",
    "night stand": "nightstand", "bedside table": "nightstand",
    "lamp": "floor lamp", "standing lamp": "floor lamp",
    "arm chair": "armchair", "easy chair": "armchair", "lounge chair": "armchair",
    "swivel chair": "office chair", "desk chair": "office chair", "dining chair": "chair",
    "ottoman": "stool", "pouf": "stool", "footstool": "stool",
}  # fmt: skip
"""Other names of the classes."""

WIDE_CLASSES: dict[str, tuple[str, ...]] = {
    "dining table": ("table", "coffee table", "desk"),
    "couch": ("sofa", "armchair"),
    "chair": ("chair", "armchair", "office chair", "stool"),
}
"""What detectors have one name for (COCO's), the likeliest first."""

SEATS = frozenset({"chair", "armchair", "office chair", "sofa", "stool", "bench", "bed"})
"""Classes that may take a sitter."""

BACKS = frozenset({"chair", "armchair", "office chair", "sofa"})
"""Classes with something to lean against."""

TOPS = frozenset({"table", "desk", "coffee table", "cabinet", "nightstand", "shelf", "bed"})
"""Classes whose top carries a hand."""

BEDS = frozenset({"bed", "sofa"})
"""Classes that one may lie on."""

WALL_PIECES = frozenset({"sofa", "bed", "desk", "shelf", "cabinet", "wardrobe", "nightstand"})
"""Classes that usually stand with their back to a wall."""

FRONTLESS = frozenset({"table", "coffee table", "stool", "bench", "floor lamp"})
"""Classes of which no side is the front, so that only their shapes distinguish turns."""


def canonical(category: str) -> str:
    """The class that `category` names, without case; unknown names are kept in lower case."""
    name = " ".join(category.lower().replace("_", " ").replace("-", " ").split())
    return SYNONYMS.get(name, name)


def make_piece(name: str, rng: np.random.Generator, style: int | None = None) -> Furniture:
    """A piece of `PIECES` of a new size, in some style where none is given.

    Raises:
        ValueError: If there is no such piece or style.
    """
    if name not in PIECES:
        raise ValueError(f"no piece {name!r}, expected one of {sorted(PIECES)}")
    if style is None:
        style = int(rng.integers(STYLES[name]))
    if not 0 <= style < STYLES[name]:
        raise ValueError(f"{name} has no style {style}, expected 0 to {STYLES[name] - 1}")
    return PIECES[name](rng, style)


def another(furniture: Furniture, rng: np.random.Generator) -> Furniture:
    """A piece of the same class with a different shape: another design where there is one."""
    names = [n for n in PIECES if canonical(n) == furniture.category]
    choices = [(n, s) for n in names for s in range(STYLES[n]) if s != furniture.style]
    name, style = choices[int(rng.integers(len(choices)))]
    return make_piece(name, rng, style)
