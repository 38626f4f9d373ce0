"""The piece of the library that is most like a box of a class."""

import difflib
import re
import unicodedata
from collections.abc import Callable, Iterable
from functools import cache, partial

import numpy as np

from mover.core.types import Mesh
from mover.furniture import seats, storage
from mover.furniture.pieces import Furniture, block, finish, pair

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
        for style in range(STYLES[name] + MORE_STYLES.get(name, 0))
        for seed in range(SEEDS)
    )


def choose_piece(category: str, size: Size) -> Mesh:
    """The mesh whose proportions are nearest to those of a box; a plain box for unknown classes.

    Nearest is the smallest sum of squared logarithms of the ratios of width, height and depth,
    so that the mesh is stretched as little as possible when it fills the box.
    """
    kind = canonical(category)
    pieces = catalogue("stool" if kind == "bar stool" else kind)
    if not pieces:
        width, height, depth = size
        box = block(pair(width / 2), (0.0, height), pair(depth / 2))
        return finish(kind, 0, [box], top=height).mesh
    stretch = [np.log(np.array(size) / np.array(piece.size)) for piece in pieces]
    return pieces[int(np.argmin([float((s * s).sum()) for s in stretch]))].mesh


# Which pieces there are: names, synonyms, sizes, and what people do with them.


PIECES: dict[str, Callable[[np.random.Generator, int], Furniture]] = {
    "chair": seats.chair,
    "armchair": seats.armchair,
    "office chair": seats.office_chair,
    "stool": seats.stool,
    "bench": seats.bench,
    "sofa": seats.sofa,
    "single bed": seats.bed,
    "double bed": partial(seats.bed, pillows=2),
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
"""Number of designs of each piece,"""

MORE_STYLES = {"single bed": 2, "double bed": 2}
"""and of those that stand for detected furniture alone: known rooms have none of them."""

SIZES: dict[str, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    "chair": ((0.40, 0.62), (0.80, 1.02), (0.40, 0.66)),
    "armchair": ((0.60, 1.00), (0.72, 1.12), (0.65, 0.95)),
    "office chair": ((0.50, 0.72), (0.88, 1.20), (0.48, 0.70)),
    "stool": ((0.30, 0.55), (0.40, 0.50), (0.30, 0.55)),
    "bench": ((0.90, 1.60), (0.40, 0.50), (0.32, 0.50)),
    "sofa": ((0.65, 3.40), (0.70, 0.92), (0.70, 1.60)),
    "bed": ((0.85, 1.95), (0.42, 1.25), (1.80, 2.25)),
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

OTHER_NAMES: dict[str, str] = {
    "sofa": "couch, loveseat, love seat, settee, settle, sectional, studio couch, corner sofa, "
    "futon, sofa bed, sleeper sofa, daybed, day bed, divan, chaise, chaise longue, "
    "chaise lounge, lounge, диван, тахта, schlafsofa, ecksofa",
    "bed": "single bed, double bed, bunk bed, loft bed, bed frame, bedframe, кровать, bett, "
    "doppelbett, cama",
    "table": "dining table, kitchen table, round table, console table, picnic table, tisch, "
    "esstisch, стол, обеденный стол, mesa",
    "desk": "writing desk, computer desk, office desk, computer table, work table, writing "
    "table, dressing table, vanity table, schreibtisch, письменный стол",
    "coffee table": "tea table, side table, end table, cocktail table, low table, corner table, "
    "couchtisch, beistelltisch, журнальный стол, журнальный столик",
    "shelf": "bookshelf, bookcase, book shelf, shelving, shelving unit, rack shelf, regal, "
    "bücherregal, полка, стеллаж, estantería",
    "cabinet": "cabinetry, cupboard, sideboard, buffet, credenza, dresser, dresser mirror, "
    "bureau, chest of drawers, drawer chest, chest of drawer, drawer, drawers, tv "
    "stand, tv unit, tv bench, television stand, kommode, anrichte, комод, тумба, "
    "schrank, schränke",
    "wardrobe": "closet, armoire, kleiderschrank, шкаф, гардероб, armario",
    "nightstand": "night stand, bedside table, night table, bedside cabinet, nachttisch, "
    "тумбочка, прикроватная тумбочка",
    "floor lamp": "lamp, standing lamp, stehlampe, торшер",
    "armchair": "arm chair, easy chair, lounge chair, club chair, wing chair, sofa chair, "
    "recliner, rocking chair, rocker, massage chair, gaming armchair, lazy sofa, "
    "sessel, кресло, sillón",
    "office chair": "swivel chair, desk chair, task chair, computer chair, gaming chair, "
    "bürostuhl",
    "chair": "dining chair, kitchen chair, side chair, seat, stuhl, stühle, стул, silla",
    "stool": "ottoman, pouf, pouffe, puff, footstool, foot stool, foot rest, footrest, hassock, "
    "hocker, табурет, табуретка, пуф",
    "bar stool": "counter stool, bar chair, high stool, barhocker, барный стул",
    "bench": "sitzbank, скамья, скамейка, лавка",
}  # fmt: skip
"""Other names of the classes: of COCO, ADE20K, NYU40, ScanNet, SUN RGB-D, 3D-FRONT, Objectron and
Open Images, and the commonest German, Russian and Spanish ones."""

OTHER_THINGS = (
    "object, other furniture, otherfurniture, otherstructure, otherprop, tv, television, "
    "monitor, screen, computer, laptop, keyboard, mouse, remote, cell phone, telephone, "
    "printer, sink, toilet, bathtub, bath, shower, refrigerator, refridgerator, fridge, mini "
    "fridge, oven, stove, microwave, toaster, dishwasher, washing machine, dryer, radiator, "
    "heater, fireplace, fan, air conditioner, piano, guitar, book, vase, clock, plant, potted "
    "plant, houseplant, flower, pillow, cushion, blanket, towel, clothes, bag, backpack, "
    "handbag, suitcase, box, basket, bucket, bin, trash can, recycle bin, bottle, cup, bowl, "
    "picture, painting, poster, whiteboard, blackboard, mirror, curtain, shower curtain, "
    "blinds, window, door, wall, floor, ceiling, stairs, column, beam, rug, carpet, mat, floor "
    "mat, table lamp, desk lamp, ceiling lamp, pendant lamp, wall lamp, bedside lamp, "
    "chandelier, light, counter, countertop, kitchen counter, kitchen island, bar, ladder, "
    "crib, infant bed, cradle, dog bed, cat bed, pet bed, flower bed, wheelchair, wheel chair, "
    "bean bag, beanbag, workbench, work bench, billiard table, pool table, camera, shoe, bike, "
    "bicycle, cereal box, toy, teddy bear, car, person, umbrella, rack, coat rack, shoe rack, "
    "paper, books, structure, bar counter, mattress, partition, screen divider, treadmill"
)
"""Things that are no furniture of the library, or none that its sizes fit; they are known names."""

NOISE = (
    "sm sk skm bp mi geo geom mesh obj prop asset model lod node grp group instance inst static "
    "item furniture the left right front rear middle small big large new old black white red "
    "blue brown green grey gray dark light wood wooden leather metal plastic modern copy clone "
    "final low high poly lowpoly highpoly seat seater sitzer rund gross groß klein eckig oval"
)
"""Words of file names and nodes that say nothing of the class."""
PLURALS = ("", ""), ("s", ""), ("es", ""), ("ves", "f"), ("ies", "y"), ("e", ""), ("en", "")

WIDE_CLASSES: dict[str, tuple[str, ...]] = {
    "dining table": ("table", "coffee table", "desk"),
    "table": ("table", "coffee table", "desk"),
    "couch": ("sofa", "armchair"),
    "chair": ("chair", "armchair", "office chair", "stool"),
}
"""What detectors and data sets have one name for, the likeliest first."""

SEATS = frozenset(
    {"chair", "armchair", "office chair", "sofa", "stool", "bar stool", "bench", "bed"}
)
"""Classes that may take a sitter."""

BACKS = frozenset({"chair", "armchair", "office chair", "sofa"})
"""Classes with something to lean against."""

WALL_PIECES = frozenset({"sofa", "bed", "desk", "shelf", "cabinet", "wardrobe", "nightstand"})
"""Classes that usually stand with their back to a wall."""


@cache
def _known_names() -> dict[str, str]:
    """The class of each known name, also where it is written as one word."""
    every = {name: name for name in OTHER_THINGS.split(", ")} | {name: name for name in SIZES}
    for kind, others in OTHER_NAMES.items():
        every |= dict.fromkeys([kind, *others.split(", ")], kind)
    return {name.replace(" ", ""): kind for name, kind in every.items()} | every


def _spelled(text: str) -> str:
    """Lower case without punctuation, numbers, CamelCase: `dining table` of SM_DiningTable_02."""
    text = unicodedata.normalize("NFC", text)  # macOS writes an umlaut of a file as two signs
    parted = re.sub(
        r"(?<=[a-z\u0430-\u0451ß])(?=[A-Z\u0410-\u042f])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text
    )
    return " ".join(re.sub(r"[\W\d_]+", " ", parted).lower().split())


@cache
def plain_name(category: str) -> str:
    """The known name in free text: `couch` of `SM_Couches_02`, else the text in lower case.

    Of several names with commas or slashes between them the first known one counts, and of a long
    name its last words (a leather sofa is a sofa).
    """
    parts = [_spelled(part) for part in re.split(r"[,;/|(]", category)]
    words = [[w for w in part.split() if w not in NOISE.split() and len(w) > 1] for part in parts]
    short = [" ".join(some) for some in words]
    turned = (" ".join(some[::-1]) for some in words)  # Table_Coffee
    tails = (" ".join(some[k:]) for some in words for k in range(1, len(some)))
    for name in (*parts, *short, *turned, *tails):  # as it is, or as a plural of a known name
        for old, new in PLURALS:
            form = name.removesuffix(old) + new if name.endswith(old) else ""
            if form in _known_names():
                return form
    whole = _spelled(category)
    return short[0] if len(parts) == 1 and short[0] else whole or category.strip().lower()


def canonical(category: str) -> str:
    """The class that `category` names; names that are not known are kept in lower case."""
    name = plain_name(category)
    return _known_names().get(name, name)


def meanings(category: str) -> tuple[str, ...]:
    """The classes that a detector may mean, the likeliest first."""
    return WIDE_CLASSES.get(plain_name(category), (canonical(category),))


def unknown_names(categories: Iterable[str]) -> str:
    """What to say of names that mean nothing here, with the nearest known ones; empty: all do."""
    known, said = _known_names(), list[str]()
    for word in sorted({c for c in categories if plain_name(c) not in known}):
        near = difflib.get_close_matches(plain_name(word), known, n=1, cutoff=0.75)
        said.append(f"{word!r}" + (f" (is it {near[0]!r}?)" if near else ""))
    if not said:
        return ""
    kinds = f"known are {', '.join(sorted(SIZES))}"
    return f"nothing is known of {', '.join(said)}: no usual size, seat or shape; {kinds}"


def make_piece(name: str, rng: np.random.Generator, style: int | None = None) -> Furniture:
    """A piece of `PIECES` of a new size, in some style where none is given.

    Raises:
        ValueError: If there is no such piece or style.
    """
    if name not in PIECES:
        raise ValueError(f"no piece {name!r}, expected one of {sorted(PIECES)}")
    if style is None:
        style = int(rng.integers(STYLES[name]))
    count = STYLES[name] + MORE_STYLES.get(name, 0)
    if not 0 <= style < count:
        raise ValueError(f"{name} has no style {style}, expected 0 to {count - 1}")
    return PIECES[name](rng, style)


def another(furniture: Furniture, rng: np.random.Generator) -> Furniture:
    """A piece of the same class with a different shape: another design where there is one."""
    names = [n for n in PIECES if canonical(n) == furniture.category]
    choices = [(n, s) for n in names for s in range(STYLES[n]) if s != furniture.style]
    name, style = choices[int(rng.integers(len(choices)))]
    return make_piece(name, rng, style)
