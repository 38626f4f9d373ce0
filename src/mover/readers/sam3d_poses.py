"""Poses of SAM 3D Objects as people save them, and the matrix that each stands for."""

from pathlib import Path

import numpy as np

from .fields import At, array, get, mapping, number, read_json, refuse
from .npz_file import read_npz
from .placing import FLIP, Matrix

TO_LOCAL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The stored mesh (+y up) -> the frame of the pose (+z up)."""
TO_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""PyTorch3D's camera (x left, y up) -> x right, y down."""
TOGETHER = ("rotation", "translation", "scale")


def pose_beside(path: Path) -> At | None:
    """The pose beside a mesh, None where there is none.

    Raises:
        InputError: If the file cannot be read.
    """
    for kind in (".npz", ".json"):
        own = path.with_suffix(kind)
        if own.is_file():
            return _listed(read_npz(own) if kind == ".npz" else read_json(own))
    return None


def poses_of(path: Path) -> dict[str, At]:
    """Poses by name; a list is in the order of the masks, and so are the rows of arrays.

    Raises:
        InputError: If the file cannot be read.
    """
    if path.suffix == ".npz":
        at = read_npz(path)
        count = len(np.atleast_2d(get(at, "rotation").value)) if "rotation" in at.value else 0
        rows = {
            str(i): {k: np.atleast_2d(at.value[k])[i] for k in TOGETHER if k in at.value}
            for i in range(count)
            if all(len(np.atleast_2d(at.value[k])) == count for k in TOGETHER if k in at.value)
        }
        return {name: _listed(At(row, path.name, name)) for name, row in rows.items()}
    at = read_json(path)
    if isinstance(at.value, list):
        return {str(i): At(row, path.name, f"[{i}]") for i, row in enumerate(at.value)}
    if "rotation" in mapping(at):
        return {"0": at}
    return {key: get(at, key) for key in at.value}


def _listed(at: At) -> At:
    """Arrays as lists, so that JSON and npz are one."""
    values = mapping(at)
    return At(
        {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()},
        at.file,
        at.field,
    )


def _numbers(at: At, count: int) -> Matrix:
    """`count` numbers in any nesting."""
    try:
        value = np.asarray(at.value, dtype=np.float64).reshape(-1)
    except (ValueError, TypeError):
        return refuse(at, f"{count} numbers")
    return array(At(value, at.file, at.field), (count,))


def pose_matrix(at: At) -> Matrix:
    """Camera from mesh (4, 4): rows v, ((v @ L.T) * scale) @ R(q) + t, then x and y turned.

    Raises:
        InputError: If a field is wrong.
    """
    q = _numbers(get(at, "rotation"), 4)
    length = float(np.linalg.norm(q))
    if not 0.5 < length < 2:
        refuse(get(at, "rotation"), "a unit quaternion (w, x, y, z)")
    w, x, y, z = (q / length).tolist()
    R = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    given = get(at, "scale")
    scale = np.array([number(given)] * 3) if isinstance(given.value, int | float) else None
    scale = _numbers(given, 3) if scale is None else scale
    if (scale <= 0).any():
        refuse(given, "scales above 0")
    matrix = np.eye(4)
    matrix[:3, :3] = TO_OPENCV @ R.T @ np.diag(scale) @ TO_LOCAL
    matrix[:3, 3] = TO_OPENCV @ _numbers(get(at, "translation"), 3)
    return matrix


def placed_already() -> Matrix:
    """Camera from mesh (4, 4) of what is already in an OpenGL camera's axes."""
    matrix = np.eye(4)
    matrix[:3, :3] = FLIP
    return matrix
