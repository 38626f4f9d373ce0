"""Nearest points and distances to surfaces, without gradients."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def nearest_points(
    query: Float[Tensor, "*starts q 3"], points: Float[Tensor, "*starts p 3"]
) -> tuple[Float[Tensor, "*starts q"], Int[Tensor, "*starts q"]]:
    """Distance [m] to, and index of, the nearest of `points` for each query point, start by start.

    Raises:
        ValueError: If there are no points to find.
    """
    from scipy.spatial import KDTree

    if points.shape[-2] == 0:
        raise ValueError("nearest_points: 'points' is empty, expected at least one point")
    if query.is_cuda:  # a tree would fetch all points from the GPU, step by step
        return torch.cdist(query, points, compute_mode="donot_use_mm_for_euclid_dist").min(-1)
    if query.ndim > 2:
        distance, index = zip(*map(nearest_points, query, points), strict=True)
        return torch.stack(distance), torch.stack(index)
    distance, index = KDTree(as_float64(points)).query(as_float64(query))
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


def enclosed(query: np.ndarray, verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether positions are inside a closed surface, wound outwards, by its winding number."""
    import igl

    return np.asarray(igl.fast_winding_number(verts, faces, query)) > 0.5


def as_float64(points: Tensor) -> np.ndarray:
    """A contiguous float64 array of a tensor anywhere."""
    return np.ascontiguousarray(points.detach().cpu().numpy(), dtype=np.float64)


def as_int64(faces: Tensor) -> np.ndarray:
    """A contiguous int64 array of a tensor anywhere."""
    return np.ascontiguousarray(faces.detach().cpu().numpy(), dtype=np.int64)
