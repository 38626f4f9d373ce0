"""A balanced tree over the triangles of a mesh: nodes with eight children, leaves of eight faces.

Its shape depends on the number of triangles only, so that it is laid out once and only its boxes
follow the poses. The eight children of a node lie together in a pack, so that one instruction
serves all of them.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int
from torch import Tensor

from .nearest import as_float64, as_int64

EIGHT = 8


@dataclass(frozen=True)
class FaceTree:
    """Slot s is lane s % 8 of pack s // 8; the children of slot s are the pack s + `shift`.

    The first pack holds the nodes of the first level in its last lanes.
    """

    corners: np.ndarray
    """Of each leaf (leaves 4 8): lowest, second and highest vertex of its eight faces, and 1, or -1
    where that order turns a face over, or 0 where a face stands there a second time."""
    shift: int
    base: int
    """Slot of the first leaf."""
    levels: tuple[int, ...]
    """First pack of each level, and the number of packs."""

    def inner(self) -> list[tuple[int, int, int]]:
        """Levels above the leaves, from below: first pack of the children, first slot, nodes."""
        pairs = list(zip(self.levels[1:-1], self.levels[2:], strict=True))
        return [(first, first - self.shift, end - first) for first, end in reversed(pairs)]


def face_tree(verts: Tensor, faces: Int[Tensor, "faces 3"]) -> FaceTree:
    """Halve the triangles again and again across their longest side."""
    triangles = as_int64(faces)
    halvings = max(0, int(np.ceil(np.log2(len(triangles) / EIGHT))))
    top = 1 << ((halvings - 1) % 3 + 1) if halvings else 1
    order = _order(as_float64(verts)[triangles].mean(1), halvings)
    packs, nodes = [0, 1], top
    while nodes < 1 << halvings:
        packs.append(packs[-1] + nodes)
        nodes *= EIGHT
    base = EIGHT * packs[-2] if len(packs) > 2 else EIGHT - top
    return FaceTree(_corners(triangles[order], halvings), top - EIGHT + 1, base, tuple(packs))


def _corners(triangles: np.ndarray, halvings: int) -> np.ndarray:
    """See `FaceTree.corners`."""
    first = np.arange((1 << halvings) + 1) * len(triangles) // (1 << halvings)
    lane = np.arange(EIGHT)
    count = np.diff(first)[:, None]
    picked = triangles[first[:-1, None] + np.minimum(lane, count - 1)]
    rank = picked.argsort(-1, kind="stable")
    turned = (rank[..., 1] - rank[..., 0]) % 3 == 1
    side = np.where(turned, 1, -1) * (lane < count)
    ordered = np.take_along_axis(picked, rank, -1)
    return np.concatenate([ordered, side[..., None]], -1).swapaxes(1, 2).astype(np.int32)


def _order(center: np.ndarray, halvings: int) -> np.ndarray:
    """Indices such that each half, quarter, ... of them is a compact group."""
    count = len(center)
    order = np.arange(count)
    for level in range(halvings):
        groups = 1 << level
        first = np.arange(groups + 1) * count // groups
        group = np.repeat(np.arange(groups), np.diff(first))
        starts, held = np.minimum(first[:-1], count - 1), center[order]
        low, size = np.minimum.reduceat(held, starts), np.maximum.reduceat(held, starts)
        with np.errstate(invalid="ignore"):  # bodies that are not finite are refused elsewhere
            size = size - low
            axis = size.argmax(-1)
            off = held[np.arange(count), axis[group]] - low[group, axis[group]]
            share = off / np.maximum(size.max(-1), 1e-30)[group]  # in its group, 0 to 1
        order = order[np.argsort(group + 0.999 * share)]
    return order
