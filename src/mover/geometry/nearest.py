"""Nearest points and distances to surfaces, without gradients."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def nearest_points(
    query: Float[Tensor, "q 3"], points: Float[Tensor, "p 3"]
) -> tuple[Float[Tensor, " q"], Int[Tensor, " q"]]:
    """Distance [m] to, and index of, the nearest of `points` for each query point.

    Raises:
        ValueError: If there are no points to find.
    """
    from scipy.spatial import KDTree

    if len(points) == 0:
        raise ValueError("nearest_points: 'points' is empty, expected at least one point")
    tree = KDTree(as_float64(points))
    distance, index = tree.query(as_float64(query))
    return torch.from_numpy(distance).to(query), torch.from_numpy(index).to(query.device)


def to_surface(
    query: Float[Tensor, "q 3"], verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"]
) -> Float[Tensor, " q"]:
    """Distance from each query point to the nearest triangle [m].

    Raises:
        ValueError: If the surface has no faces.
    """
    if len(faces) == 0:
        raise ValueError("to_surface: 'faces' is empty, expected at least one triangle")
    if len(query) == 0:
        return query.new_zeros(0)
    squared, _, _ = closest(as_float64(query), as_float64(verts), as_int64(faces))
    return torch.from_numpy(np.sqrt(squared)).to(query)


def closest(
    query: np.ndarray, verts: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared distance [m²], face and place of the nearest surface point of each query point."""
    import igl

    squared, face, place = igl.point_mesh_squared_distance(query, verts, faces)
    return np.asarray(squared), np.asarray(face), np.asarray(place)


SIDE = 0.05  # [m], of the cells whose places may share an answer: fewest are left to ask


def enclosed(
    query: np.ndarray, verts: np.ndarray, faces: np.ndarray, distance: np.ndarray
) -> np.ndarray:
    """Whether places are inside a closed surface, by its winding number.

    Only one place of a cell is asked for all that no surface can part from it.

    Args:
        query: The places [m].
        verts: Of the surface [m].
        faces: Wound outwards.
        distance: Of each place from the surface [m].
    """
    import igl

    cells = np.floor(query / SIDE).astype(np.int64)
    cells -= cells.min(0)
    key = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    other = first[of]
    away = np.linalg.norm(query - query[other], axis=1)
    alone = away >= np.maximum(distance, distance[other])
    alone[first] = True
    inside = np.zeros(len(query), dtype=bool)
    inside[alone] = np.asarray(igl.fast_winding_number(verts, faces, query[alone])) > 0.5
    return inside[np.where(alone, np.arange(len(query)), other)]


def as_float64(points: Tensor) -> np.ndarray:
    """A contiguous float64 array of a tensor anywhere."""
    return np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64)


def as_int64(faces: Tensor) -> np.ndarray:
    """A contiguous int64 array of a tensor anywhere."""
    return np.ascontiguousarray(faces.detach().cpu().numpy(), dtype=np.int64)
