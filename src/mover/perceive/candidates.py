"""Shapes that a detected thing may have: designs of the furniture library, or the user's meshes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..furniture.choose import catalogue, choose_piece
from ..furniture.library import canonical
from ..geometry.mesh import box, used
from ..readers.fields import At
from ..readers.mesh_file import KINDS, read_mesh
from ..records import InputError
from ..types import Mesh

WIDE_CLASSES = {"dining table": ("table", "coffee table", "desk"), "couch": ("sofa", "armchair")}
"""COCO has one name for what the library tells apart."""

OTHER_SIZES: dict[str, tuple[float, float, float]] = {
    "refrigerator": (0.70, 1.70, 0.70), "oven": (0.60, 0.90, 0.60), "toilet": (0.40, 0.78, 0.66),
    "potted plant": (0.50, 0.90, 0.50), "piano": (1.50, 1.15, 0.60), "bathtub": (1.60, 0.58, 0.75),
    "washing machine": (0.60, 0.86, 0.60), "box": (0.50, 0.40, 0.50),
}  # fmt: skip
"""Usual width, height and depth of things that the library lacks [m]; they become blocks."""

NOT_ON_FLOOR = frozenset({
    "tv", "television", "laptop", "sink", "microwave", "toaster", "book", "vase", "clock", "pillow",
    "window", "door", "wall", "floor", "ceiling", "picture", "mirror", "curtain", "blinds",
    "keyboard", "mouse", "remote", "cell phone", "bottle", "cup", "bowl", "person",
})  # fmt: skip
"""What does not stand on the ground by itself: it is not placed."""

UNKNOWN_SIZE = (0.60, 0.80, 0.60)


@dataclass(frozen=True)
class Shape:
    """One possible shape at its usual size."""

    mesh: Mesh
    file: str
    """Where it came from; empty: the library."""
    size: tuple[float, float, float]
    """Edges of its box [m]."""


def is_placed(category: str) -> bool:
    """Whether a thing of this class stands on the ground."""
    return canonical(category) not in NOT_ON_FLOOR


def shapes_of(category: str, count: int, folder: Path | None = None) -> tuple[Shape, ...]:
    """At most `count` shapes of a class that differ most in size and design.

    Args:
        category: Free text.
        count: Most shapes.
        folder: The user's meshes, named after their class: `chair_0.obj`; they come before the
            library's.

    Raises:
        InputError: If a mesh cannot be read.
    """
    own = () if folder is None else _own_shapes(canonical(category), folder)
    if own:
        return _different(own, count)
    names = WIDE_CLASSES.get(category.lower(), (canonical(category),))
    known = [
        Shape(piece.mesh, "", piece.size) for name in names for piece in catalogue(canonical(name))
    ]
    if not known:
        size = OTHER_SIZES.get(canonical(category), UNKNOWN_SIZE)
        return (Shape(choose_piece(category, size), "", size),)
    return _different(tuple(known), count)


def _different(shapes: tuple[Shape, ...], count: int) -> tuple[Shape, ...]:
    """The most usual shape, then always the one that is farthest from all that are taken."""
    if len(shapes) <= count:
        return shapes
    logs = np.log(np.array([shape.size for shape in shapes]))
    taken = [int(np.abs(logs - np.median(logs, axis=0)).sum(1).argmin())]
    far = np.full(len(shapes), np.inf)
    while len(taken) < count:
        far = np.minimum(far, np.square(logs - logs[taken[-1]]).sum(1))
        taken.append(int(far.argmax()))
    return tuple(shapes[k] for k in taken)


def _own_shapes(category: str, folder: Path) -> tuple[Shape, ...]:
    """The user's meshes of a class."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected meshes like chair_0.obj")
    found: list[Shape] = []
    for path in sorted(folder.iterdir()):
        name = path.stem.rstrip("0123456789_- ")
        if path.suffix.lower() in KINDS and canonical(name) == category:
            mesh, file = read_mesh(At(path.name, path.name), folder)
            low, high = box(used(mesh).verts)
            x, y, z = (high - low).tolist()
            found.append(Shape(mesh, file, (x, y, z)))
    return tuple(found)
