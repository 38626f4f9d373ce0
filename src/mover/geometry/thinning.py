"""Fewer points and fewer triangles that still show the shape."""

from threading import Lock
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.geometry.nearest import as_float64, as_int64
from mover.geometry.topology import is_closed

simplifying = Lock()
"""Held while fast_simplification works: on global variables."""


def farthest_first(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """The first point, and so on the one that is farthest from all before; the first of equals."""
    x, y, z = np.ascontiguousarray(points.detach().cpu().float().numpy().T)
    chosen = np.zeros(count, dtype=np.int64)
    nearest = np.full(len(x), np.inf, dtype=np.float32)
    for row in range(1, count):
        at = chosen[row - 1]
        np.minimum(nearest, (x - x[at]) ** 2 + (y - y[at]) ** 2 + (z - z[at]) ** 2, out=nearest)
        chosen[row] = nearest.argmax()
    return torch.from_numpy(chosen).to(points.device)


def chosen_vertices(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> tuple[Int[Tensor, " fewer"], Int[Tensor, "triangles 3"]] | None:
    """Vertices that stand for all, and about `count` triangles between them.

    Each vertex of the simplified mesh is replaced by the nearest of those that collapsed into it;
    None where one has none.
    """
    import fast_simplification

    points, rows = as_float64(verts), as_int64(faces).astype(np.int32)
    with simplifying:
        found: Any = fast_simplification.simplify(
            points, rows, target_count=count, return_collapses=True
        )
        fewer, rows, group = fast_simplification.replay_simplification(points, rows, found[2])
    order = np.lexsort([np.linalg.norm(points - fewer[group], axis=1), group])
    nearest = order[np.unique(group[order], return_index=True)[1]]
    if len(nearest) < len(fewer):
        return None
    return torch.from_numpy(nearest), torch.from_numpy(rows.astype(np.int64)).to(faces)


def coarser(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> tuple[Float[Tensor, "meshes fewer 3"], Int[Tensor, "triangles 3"]]:
    """Meshes of one topology with about `count` triangles, all simplified as the first one is.

    Each of the new vertices is an old one. Meshes of fewer triangles, and those that would not be
    closed any more, stay as they are.
    """
    if len(meshes) == 0 or len(faces) <= count:
        return meshes, faces
    found = chosen_vertices(meshes[0], faces, count)
    if found is None or not is_closed(found[1]):
        return meshes, faces
    return meshes[:, found[0].to(meshes.device)].contiguous(), found[1]
