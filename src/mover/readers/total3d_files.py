"""The files of Total3D and Implicit3D: boxes and matrices (.mat), meshes."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..records import InputError
from .fields import At, array, get, refuse
from .mat_file import load_mat
from .mesh_file import KINDS, read_mesh
from .nyu40 import CLASSES

Shape = tuple[NDArray[np.float64], NDArray[np.int64]]
"""All vertices and triangles of a mesh, used or not."""


@dataclass(frozen=True)
class Box:
    """A box of bdb_3d.mat in Total3D's world."""

    center: NDArray[np.float64]
    half: NDArray[np.float64]
    yaw: float
    name: str


def matrix(path: Path, key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A matrix of a MATLAB file."""
    return array(get(load_mat(path), key), shape).astype(np.float64)


def read_boxes(path: Path) -> list[Box]:
    """All boxes, in the order of the detections."""
    content = load_mat(path)
    cells = get(content, "bdb")
    if not isinstance(cells.value, np.ndarray) or cells.value.dtype != object:
        refuse(cells, "a cell of boxes")
    ids = array(get(content, "class_id"), (1, cells.value.size), "whole")[0]
    found: list[Box] = []
    for i, (cell, key) in enumerate(zip(cells.value.ravel(), ids.tolist(), strict=True)):
        at = At(cell, content.file, f"bdb[{i}]")
        if not 0 <= key < len(CLASSES):
            refuse(get(content, "class_id"), f"ids from 0 to {len(CLASSES) - 1}", f"{key}")
        found.append(_box(at, CLASSES[key]))
    return found


def _box(at: At, name: str) -> Box:
    """One box: its axes are the rows of `basis`, upright; p = p_local @ basis + centroid."""
    names = (
        at.value.dtype.names if isinstance(at.value, np.ndarray) and at.value.size == 1 else None
    )
    if not names or not {"basis", "coeffs", "centroid"} <= set(names):
        refuse(at, "a struct with basis, coeffs, centroid")
    struct = at.value.ravel()[0]
    parts = {key: At(struct[key], at.file, f"{at.field}.{key}") for key in names}
    basis = array(parts["basis"], (3, 3)).astype(np.float64)
    half = array(parts["coeffs"], (1, 3)).astype(np.float64)[0]
    if (half <= 0).any():
        refuse(parts["coeffs"], "half sizes above 0", f"{half.tolist()}")
    yaw = math.atan2(basis[2, 0], basis[2, 2])
    c, s = math.cos(yaw), math.sin(yaw)
    if abs(basis - np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])).max() > 1e-3:
        refuse(parts["basis"], "the axes of an upright box", f"{basis.round(3).tolist()}")
    return Box(array(parts["centroid"], (1, 3)).astype(np.float64)[0], half, yaw, name)


def find_mesh(folder: Path, index: int, name: str) -> Path:
    """The mesh of a box: `<index>_<class id>.obj`, or another kind of mesh with this name.

    Raises:
        InputError: If there is none.
    """
    stem = f"{index}_{CLASSES.index(name)}"
    for kind in (".obj", *KINDS):
        if (path := folder / (stem + kind)).is_file():
            return path
    raise InputError(f"{stem}.obj: there is no such file in {folder}, expected a mesh")


def read_shape(path: Path) -> Shape:
    """All vertices and triangles of a mesh; of an .obj also those vertices that are not used.

    Raises:
        InputError: If it cannot be read.
    """
    if path.suffix != ".obj":
        mesh, _ = read_mesh(At(path.name, path.name), path.parent)
        return mesh.verts.double().numpy(), mesh.faces.numpy()
    lines = [line.split() for line in path.read_text(errors="replace").splitlines()]
    try:
        verts = np.array([line[1:4] for line in lines if line[:1] == ["v"]], dtype=np.float64)
        corners = [[c.split("/")[0] for c in line[1:]] for line in lines if line[:1] == ["f"]]
        faces = np.array(corners, dtype=np.int64).reshape(-1, 3) - 1
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path.name}: has {error}, expected vertices and triangles") from error
    array(At(verts, path.name, "v"), ("V", 3))
    if not len(verts):
        raise InputError(f"{path.name}: has an empty mesh, expected vertices and triangles")
    return verts, faces
