"""Fewer triangles for a view; the result's own files keep all of theirs."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Mesh

GRAIN = 1e-4  # share of the longest side within which vertices are the same


@dataclass(frozen=True)
class Thinning:
    """A choice of vertices that stands for all, and triangles between them."""

    kept: Int[Tensor, " kept"]
    """Indices into the original vertices."""
    faces: Int[Tensor, "faces 3"]
    """Indices into `kept`."""


def thin(mesh: Mesh, count: int) -> Mesh:
    """The mesh with at most about `count` faces; soups are welded first."""
    from fast_simplification import simplify

    verts, faces = _welded(mesh)
    if len(faces) > count:
        verts, faces, *_ = simplify(verts, faces.astype(np.int32), target_count=count)
    if not len(faces):
        return mesh
    return Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces.astype(np.int64)))


def thin_choice(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> Thinning:
    """Choose vertices of one pose so that all other poses can be drawn with them as well.

    Each vertex of the simplified mesh is replaced by the nearest of those that collapsed into it.
    """
    from fast_simplification import replay_simplification, simplify

    if len(faces) <= count:
        used, ends = faces.cpu().long().unique(return_inverse=True)
        return Thinning(used, ends.reshape(-1, 3))
    points = verts.detach().cpu().double().numpy()
    triangles = faces.cpu().int().numpy()
    *_, collapses = simplify(points, triangles, target_count=count, return_collapses=True)
    fewer, kept_faces, heir = replay_simplification(points, triangles, collapses)
    used = np.unique(triangles)
    heirs = np.asarray(heir)[used]
    far = np.linalg.norm(points[used] - np.asarray(fewer)[heirs], axis=1)
    order = np.lexsort((far, heirs))
    first = np.unique(heirs[order], return_index=True)
    choice = np.zeros(len(fewer), dtype=np.int64)
    choice[first[0]] = used[order][first[1]]
    return Thinning(torch.from_numpy(choice), torch.from_numpy(np.asarray(kept_faces, np.int64)))


def _welded(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices that share a place become one; collapsed and doubled triangles go."""
    verts = mesh.verts.detach().cpu().double().numpy()
    faces = mesh.faces.cpu().long().numpy()
    used, faces = np.unique(faces, return_inverse=True)
    verts, faces = verts[used], faces.reshape(-1, 3)
    grain = GRAIN * max(float(np.ptp(verts, axis=0).max()), 1e-9)
    _, first, same = np.unique(
        np.round(verts / grain).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = same.reshape(-1)[faces]
    kept = (faces != np.roll(faces, 1, axis=1)).all(1)
    _, once = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)
    return verts[first], faces[kept][np.sort(once)]
