"""A balanced tree over the triangles of a mesh, four levels deep.

Its shape depends on the number of triangles only, so that it is laid out once and only its boxes
follow the poses.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from torch import Tensor

from .nearest import as_float64, as_int64

LEVELS = 4
LEAF = 8  # triangles of a leaf, at most, but for huge meshes
MOST = 5  # halvings from one level to the next, at most


@dataclass(frozen=True)
class FaceTree:
    """The triangles in the order of the leaves; node k of a level has children k * branches, ..."""

    faces: np.ndarray
    first: np.ndarray
    """First triangle of each leaf, and an end."""
    branches: int
    """Children of a node, and nodes of the first level."""

    def starts(self) -> list[int]:
        """Number of the first node of each level, and the number of nodes."""
        sizes = [self.branches ** (level + 1) for level in range(LEVELS)]
        return [0, *np.cumsum(sizes).tolist()]


def face_tree(verts: Tensor, faces: Int[Tensor, "faces 3"]) -> FaceTree:
    """Halve the triangles again and again across their longest side."""
    triangles = as_int64(faces)
    count, halvings = len(triangles), 0
    while count > LEAF << (LEVELS * halvings) and halvings < MOST:
        halvings += 1
    order = _order(as_float64(verts)[triangles].mean(1), LEVELS * halvings)
    leaves = 1 << (LEVELS * halvings)
    first = np.arange(leaves + 1) * count // leaves
    return FaceTree(triangles[order].astype(np.int32), first.astype(np.int32), 1 << halvings)


def _order(center: np.ndarray, halvings: int) -> np.ndarray:
    """Indices such that each half, quarter, ... of them is a compact group."""
    count = len(center)
    order = np.arange(count)
    for level in range(halvings):
        groups = 1 << level
        first = np.arange(groups + 1) * count // groups
        group = np.repeat(np.arange(groups), np.diff(first))
        starts = np.minimum(first[:-1], count - 1)
        high = np.maximum.reduceat(center[order], starts)
        low = np.minimum.reduceat(center[order], starts)
        axis = (high - low).argmax(-1)
        order = order[np.lexsort((center[order, axis[group]], group))]
    return order
