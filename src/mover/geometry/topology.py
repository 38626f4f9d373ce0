"""How the triangles of a surface hang together: half-edges, neighbours, components.

Half-edge 3 f + k of face f runs from its corner k to its corner k + 1. A surface is closed and
wound in one orientation when every half-edge has a mate that runs the other way. Where two pairs
of faces share one edge (solids that touch, marching cubes), every half-edge still gets one mate.
"""

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from .nearest import as_int64


def is_closed(faces: Int[Tensor, "faces 3"]) -> bool:
    """Whether every edge has exactly two faces, which run along it in opposite directions."""
    tails, heads = half_edges(as_int64(faces))
    if len(tails) == 0 or (tails == heads).any():
        return False
    size = int(max(tails.max(), heads.max())) + 1
    forward = np.sort(tails * size + heads)
    return bool((forward[1:] != forward[:-1]).all()) and np.array_equal(
        forward, np.sort(heads * size + tails)
    )


def edges_of(faces: Int[Tensor, "faces 3"]) -> Int[Tensor, "edges 4"]:
    """Edges of a closed surface: two vertices, then the face that runs v0 to v1, and its mate.

    An edge that four faces share appears twice, each time with faces of one component if possible.

    Raises:
        ValueError: If the surface is open or its faces are not wound in one orientation.
    """
    corners = as_int64(faces)
    mates = mates_of(corners)
    if mates is None:
        raise ValueError("edges_of: the mesh is open or its winding is inconsistent; close it")
    tails, heads = half_edges(corners)
    first = np.nonzero(tails < heads)[0]
    rows = np.stack([tails[first], heads[first], first // 3, mates[first] // 3], -1)
    return torch.from_numpy(rows).to(faces)


def half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and second vertex of the half-edges 3 f + k."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def mates_of(faces: np.ndarray, verts: np.ndarray | None = None) -> np.ndarray | None:
    """The opposite half-edge of each; None if the surface is not closed or not consistent.

    Args:
        faces: Triangles, none of them degenerate.
        verts: If given, those of one component around a shared edge are paired as the walls of a
            wedge of matter; otherwise in the order of the faces.
    """
    tails, heads = half_edges(faces)
    low, high = np.minimum(tails, heads), np.maximum(tails, heads)
    _, edge = np.unique(low * (faces.max() + 1) + high, return_inverse=True)
    if (tails == heads).any():
        return None
    forward, backward = _by_edge(edge, tails == low), _by_edge(edge, tails != low)
    if len(forward) != len(backward) or (edge[forward] != edge[backward]).any():
        return None
    mates = np.empty(len(tails), dtype=np.int64)
    mates[forward], mates[backward] = backward, forward
    shared = np.nonzero(np.bincount(edge[forward]) > 1)[0]
    if len(shared):
        _pair_shared(mates, edge, shared, faces, verts)
    return mates


def _by_edge(edge: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The chosen half-edges, sorted by their edge."""
    index = np.nonzero(chosen)[0]
    return index[np.argsort(edge[index], kind="stable")]


def _pair_shared(
    mates: np.ndarray,
    edge: np.ndarray,
    shared: np.ndarray,
    faces: np.ndarray,
    verts: np.ndarray | None,
) -> None:
    """Set the mates of the half-edges on edges that more than two faces share."""
    busy = np.isin(edge, shared)
    half = np.arange(len(edge))
    lone = half[~busy & (half < mates)]
    component = labels(lone // 3, mates[lone] // 3, len(faces))
    tails, heads = half_edges(faces)
    order = np.nonzero(busy)[0]
    order = order[np.argsort(edge[order], kind="stable")]
    for group in np.split(order, np.flatnonzero(np.diff(edge[order])) + 1):
        ahead = tails[group] < heads[group]
        out, back = group[ahead], group[~ahead]
        cost = (component[out // 3][:, None] != component[back // 3]) * 2 * np.pi
        if verts is not None:
            cost = cost + _wedges(out, back, faces, verts)
        back = back[_matched(cost)]
        mates[out], mates[back] = back, out


def _wedges(out: np.ndarray, back: np.ndarray, faces: np.ndarray, verts: np.ndarray) -> np.ndarray:
    """Angle of the matter between each two faces around an edge [rad], in [0, 2 pi).

    Around an edge that points at the viewer, the normal of a face that runs along it points
    counter-clockwise: matter begins there, clockwise, and ends at the next face.
    """
    root, tip = faces[out[0] // 3, out[0] % 3], faces[out[0] // 3, (out[0] + 1) % 3]
    along = verts[tip] - verts[root]
    halves = np.concatenate([out, back])
    apexes = verts[faces[halves // 3, (halves + 2) % 3]] - verts[root]
    apexes = apexes - np.outer(apexes @ along, along) / max(float(along @ along), 1e-300)
    side = np.cross(along, apexes[0])
    angle = np.arctan2(apexes @ side, apexes @ apexes[0] * np.linalg.norm(along))
    return (angle[: len(out), None] - angle[len(out) :]) % (2 * np.pi)


def _matched(cost: np.ndarray) -> np.ndarray:
    """A column of its own for each row, the cheapest first."""
    cost, chosen = cost.astype(np.float64), np.zeros(len(cost), dtype=np.int64)
    for _ in range(len(cost)):
        row, column = np.unravel_index(cost.argmin(), cost.shape)
        chosen[row] = column
        cost[row], cost[:, column] = np.inf, np.inf
    return chosen


def labels(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """Component of each of `count` nodes that the links a-b join."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def manifold(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The same closed surface with exactly two faces at every edge; None if it is not closed.

    Every fan of mated faces around a vertex gets a vertex of its own. An edge that still has four
    faces, because its two pairs belong to one fan at both ends, gets a middle for one pair.
    """
    while True:
        mates = mates_of(faces, verts)
        if mates is None:
            return None
        half = np.arange(len(mates))
        after = half - half % 3 + (half + 1) % 3  # a corner has the number of its half-edge
        starts, ends = np.concatenate([half, after]), np.concatenate([after[mates], mates])
        fan = labels(starts, ends, len(mates))
        verts = verts[faces.ravel()[np.unique(fan, return_index=True)[1]]]
        faces = fan.reshape(-1, 3)
        tails, heads = half_edges(faces)
        _, first = np.unique(tails * len(verts) + heads, return_index=True)
        again = tails < heads
        again[first] = False
        twice = np.flatnonzero(again)
        if len(twice) == 0:
            return verts, faces
        verts, faces = _with_middle(verts, faces, int(twice[0]), int(mates[twice[0]]))


def _with_middle(
    verts: np.ndarray, faces: np.ndarray, half: int, mate: int
) -> tuple[np.ndarray, np.ndarray]:
    """With a vertex in the middle of the edge between two mated half-edges."""
    middle, pieces = len(verts), list[list[int]]()
    for one in (half, mate):
        tail, head, apex = np.roll(faces[one // 3], -(one % 3)).tolist()
        pieces += [[tail, middle, apex], [middle, head, apex]]
    point = verts[faces[half // 3, [half % 3, (half + 1) % 3]]].mean(0)
    rest = np.delete(faces, [half // 3, mate // 3], axis=0)
    return np.vstack([verts, point]), np.vstack([rest, pieces])
