"""Where a vertex lies on a body, whatever the pose: walking distances to head, hands and feet.

Distances along the skin hardly change when a person moves, so they tell head, hands and feet of any
human mesh apart, and match its vertices to those of a known one.
"""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray

TIPS = ("head", "left_hand", "right_hand", "left_foot", "right_foot")
"""The five ends of a body."""
CANDIDATES = 8
"""Ends to choose the five from."""
SIDED = ([0, 1, 2, 3, 4], [0, 2, 1, 4, 3], [0, 2, 1, 3, 4], [0, 1, 2, 4, 3])
"""Orders of `TIPS` when left and right of nothing, all, hands or feet change places."""


@dataclass(frozen=True)
class Walks:
    """Distances over the skin of one mesh."""

    tips: Int[Array, "5"]
    """Vertices at the ends of the body, in the order of `TIPS`."""
    far: Float[Array, "verts 5"]
    """From each vertex to each tip [m]; inf where no way leads there."""


def ends(
    verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"], count: int = CANDIDATES
) -> tuple[Int[Array, " ends"], Float[Array, "verts ends"]]:
    """Vertices far from each other, head, hands and feet among them, and all distances to them [m].

    The belly is often farther from all hands and feet than the head is, hence more than five.
    """
    graph = _graph(verts, faces)
    tips = [_farthest(graph, _farthest(graph, _largest(graph)))]
    far = [_from(graph, tips[0])]
    while len(tips) < count:
        nearest = np.min(far, axis=0)
        tips.append(int(np.argmax(np.where(np.isfinite(nearest), nearest, -1))))
        far.append(_from(graph, tips[-1]))
    return np.array(tips), np.stack(far, axis=1)


def match_ends(
    verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"], known: Float[Array, "5 5"]
) -> tuple[Walks, float, float]:
    """Find head, hands and feet by the distances between them in a known body.

    Left and right may be exchanged: distances cannot tell.

    Returns:
        The walks, the size relative to the known body, and the root mean square of the mismatch of
        the distances between ends relative to their mean.
    """
    tips, far = ends(verts, faces)
    orders = np.array(list(itertools.permutations(range(len(tips)), len(TIPS))))
    here = far[tips][orders[:, :, None], orders[:, None, :]]
    size = ((here * known).sum((1, 2)) / np.square(known).sum()).clip(min=1e-9)
    wrong = np.sqrt(np.square(here / size[:, None, None] - known).mean((1, 2))) / known.mean()
    best = int(np.argmin(wrong))
    order = orders[best]
    return Walks(tips[order], far[:, order]), float(size[best]), float(wrong[best])


def _graph(verts: Float[Array, "verts 3"], faces: Int[Array, "faces 3"]) -> Any:  # noqa: ANN401
    """Sparse matrix of straight distances to neighbours and to their neighbours.

    Vertices at one place (seams) count as one: a tiny step joins them.
    """
    from scipy import sparse

    _, first, same = np.unique(np.round(verts, 7), axis=0, return_index=True, return_inverse=True)
    twin = first[same.ravel()]
    seam = np.nonzero(twin != np.arange(len(verts)))[0]
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([twin[ends], np.stack([seam, twin[seam]], axis=1)])
    size = (len(verts), len(verts))
    once = sparse.coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=size).tocsr()
    once = once + once.T
    pairs = (once + once @ once).tocoo()
    keep = pairs.row < pairs.col
    row, col = pairs.row[keep], pairs.col[keep]
    length = np.maximum(np.linalg.norm(verts[row] - verts[col], axis=1), 1e-9)
    return sparse.coo_matrix((length, (row, col)), shape=size).tocsr()


def _largest(graph: Any) -> int:  # noqa: ANN401
    """A vertex of the component with the most vertices."""
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(graph, directed=False)
    return int(np.argmax(label == np.bincount(label).argmax()))


def _from(graph: Any, source: int) -> Float[Array, " verts"]:  # noqa: ANN401
    from scipy.sparse.csgraph import dijkstra

    return dijkstra(graph, directed=False, indices=source)


def _farthest(graph: Any, source: int) -> int:  # noqa: ANN401
    far = _from(graph, source)
    return int(np.argmax(np.where(np.isfinite(far), far, -1)))
