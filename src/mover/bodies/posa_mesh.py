"""The coarse meshes that POSA works on, and the ways between them: its folder mesh_ds."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..records import BROKEN, InputError

LEVELS = (10475, 2619, 655)
"""Vertices of the full body and of the two coarser ones."""


@dataclass(frozen=True)
class Pyramid:
    """From the full body to the coarse mesh, and back."""

    verts: Float[np.ndarray, "coarse 3"]
    faces: Int[np.ndarray, "faces 3"]
    down: tuple[Tensor, ...]
    """Sparse matrices to coarser meshes, in order."""
    up: tuple[Tensor, ...]
    """Sparse matrices back, in order."""


def read_pyramid(folder: Path) -> Pyramid:
    """Read mesh_2.obj, D_1, D_2, U_1 and U_2 from POSA's folder mesh_ds.

    Raises:
        InputError: If a file is missing or has the wrong size.
    """
    verts, faces = read_obj(folder / "mesh_2.obj")
    full, middle, coarse = LEVELS
    if len(verts) != coarse:
        raise InputError(f"mesh_2.obj: has {len(verts)} vertices, expected {coarse}")
    down = (
        _sparse(folder / "D_1.npz", (middle, full)),
        _sparse(folder / "D_2.npz", (coarse, middle)),
    )
    up = (
        _sparse(folder / "U_2.npz", (middle, coarse)),
        _sparse(folder / "U_1.npz", (full, middle)),
    )
    return Pyramid(verts, faces, down, up)


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles in the order of the file; nothing is merged.

    Raises:
        InputError: If it is missing or is no such file.
    """
    verts: list[list[float]] = []
    faces: list[list[int]] = []
    try:
        for words in (line.split() for line in path.read_text().splitlines()):
            if words[:1] == ["v"]:
                verts.append([float(w) for w in words[1:4]])
            elif words[:1] == ["f"]:
                faces.append([int(w.split("/")[0]) - 1 for w in words[1:4]])
    except BROKEN as error:
        raise InputError(f"{path}: cannot be read as a mesh ({error})") from error
    return np.asarray(verts).reshape(-1, 3), np.asarray(faces, dtype=np.int64).reshape(-1, 3)


def _sparse(path: Path, shape: tuple[int, int]) -> Tensor:
    """A matrix in scipy's file format."""
    from scipy import sparse

    try:
        matrix: Any = sparse.load_npz(path).tocoo()
    except BROKEN as error:
        raise InputError(f"{path}: cannot be read as a sparse matrix ({error})") from error
    if matrix.shape != shape:
        raise InputError(f"{path.name}: has the shape {matrix.shape}, expected {shape}")
    index = torch.from_numpy(np.stack([matrix.row, matrix.col]).astype(np.int64))
    values = torch.from_numpy(np.asarray(matrix.data, dtype=np.float32))
    return torch.sparse_coo_tensor(index, values, shape, check_invariants=True).coalesce()
