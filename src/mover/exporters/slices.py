"""Convex pieces by cuts along the axes, where coacd is not installed; exact for boards and legs."""

import heapq
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLANES = 24  # places that are tried along each axis
SMALLEST = 1e-7  # of the volume; less is a scrap of a cut


def sliced(
    verts: NDArray[np.float64], faces: NDArray[np.int64], concavity: float, most: int
) -> tuple[list[NDArray[np.float64]], float]:
    """Points of convex pieces of a closed mesh, and what their hulls add, as a share of its volume.

    The piece whose hull is the most too large is cut by the plane that leaves the smallest hulls,
    until all that hulls add is a share `concavity` of the volume, or there are `most` pieces.
    """
    import manifold3d

    mesh = manifold3d.Mesh64(
        vert_properties=np.ascontiguousarray(verts),
        tri_verts=np.ascontiguousarray(faces.astype(np.uint64)),
    )
    solid = manifold3d.Manifold(mesh)
    if solid.is_empty():
        return [verts], float("inf")
    total, order = solid.volume(), count()
    heap: list[tuple[float, int, Any]] = []
    done: list[Any] = []
    for part in solid.decompose():
        heapq.heappush(heap, (-_excess(part), next(order), part))
    while heap and len(heap) + len(done) < most and _sum(heap) > concavity * total:
        _, _, worst = heapq.heappop(heap)
        halves = _best_cut(worst)
        if halves is None:
            done.append(worst)
            continue
        for half in halves:
            for part in half.decompose():
                if part.volume() > SMALLEST * total:
                    heapq.heappush(heap, (-_excess(part), next(order), part))
    parts = [*done, *(part for _, _, part in heap)]
    clouds = [np.array(part.to_mesh64().vert_properties[:, :3]) for part in parts]
    return clouds, sum(_excess(part) for part in parts) / total


def _sum(heap: list[tuple[float, int, Any]]) -> float:
    return -sum(excess for excess, _, _ in heap)


def _excess(part: Any) -> float:  # noqa: ANN401
    """What its hull adds to a piece [m³]."""
    return part.hull().volume() - part.volume()


def _best_cut(part: Any) -> tuple[Any, Any] | None:  # noqa: ANN401
    """The two halves with the smallest hulls, None if no cut makes them smaller."""
    verts = np.array(part.to_mesh64().vert_properties[:, :3])
    least, found = _excess(part) * 0.999, None
    for axis, normal in enumerate(np.eye(3)):
        for place in _places(verts[:, axis]):
            halves = part.split_by_plane(normal, place)
            if any(half.is_empty() for half in halves):
                continue
            excess = sum(_excess(half) for half in halves)
            if excess < least:
                least, found = excess, halves
    return found


def _places(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where edges lie along an axis, thinned to `PLANES`, without the ends."""
    inner = np.unique(np.round(values, 5))
    span = inner[-1] - inner[0]
    inner = inner[(inner > inner[0] + 0.002 * span) & (inner < inner[-1] - 0.002 * span)]
    if len(inner) <= PLANES:
        return inner
    return inner[np.linspace(0, len(inner) - 1, PLANES).round().astype(int)]
