"""Total3D's folders: input/ (picture, intrinsics, detections) and output/ (camera, boxes, meshes).

Its world has x forward, y up, z right, and the camera at the origin. Its boxes have half sizes and
rows of axes; a mesh is stretched to its box. Its intrinsics belong to its own pixel grid, which
is taken as the image's: no half pixel is added.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..records import InputError
from ..types import Camera, Capture, Mesh
from .assemble import Sources, assemble
from .fields import At, Warn, array, choice, get, items, read_json, reason, refuse, vector
from .image_file import image_size, read_image
from .mesh_file import mesh_of
from .nyu40 import CLASSES, FURNITURE, LIFTED
from .scene_file import FORMAT, VERSION

ON_FLOOR = 0.3  # [m], such a thing stands on the floor if its box ends so close above it
TO_OURS = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""x forward, y up, z right -> x right, y up, z backward."""
TO_IMAGE = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""x forward, y up, z right -> x right, y down, z forward."""


@dataclass(frozen=True)
class _Box:
    """A box of bdb_3d.mat in Total3D's world."""

    center: NDArray[np.float64]
    half: NDArray[np.float64]
    yaw: float
    name: str


_Shape = tuple[NDArray[np.float64], NDArray[np.int64]]


def read_total3d(folder: Path) -> Capture:
    """Read the input and the output of Total3D for one picture.

    Raises:
        InputError: If a file is missing or wrong.
    """
    source, result = folder / "input", folder / "output"
    rows = _detections(read_json(source / "detections.json"))
    boxes = _boxes(result / "bdb_3d.mat")
    floor = float(_matrix(result / "layout.mat", "layout", (8, 3))[:, 1].min())
    if [name for name, _ in rows] != [box.name for box in boxes]:
        found = f"{len(boxes)} boxes of {[b.name for b in boxes][:4]} ..."
        expected = "the classes of detections.json, in order"
        raise InputError(f"bdb_3d.mat: field 'class_id' has {found}, expected {expected}")
    kept = [i for i, box in enumerate(boxes) if box.name in FURNITURE]
    shapes = {_obj_name(i, boxes[i]): _read_obj(result / _obj_name(i, boxes[i])) for i in kept}
    pieces = [_piece(i, boxes[i], shapes[_obj_name(i, boxes[i])][0], floor) for i in kept]
    scene = {"format": FORMAT, "version": VERSION, "ground": {"height": floor}, "objects": pieces}
    return assemble(
        Sources(
            name=folder.resolve().name,
            camera=_camera(source, result / "r_ex.mat"),
            scene=At(scene, "output"),
            objects=At(_annotations(rows, kept), "detections.json"),
            people=None,
            bodies=None,
            contacts=None,
            load_mesh=partial(_load_mesh, result, shapes),
            load_image=partial(_load_image, source),
            n_frames=None,
        )
    )


def _obj_name(index: int, box: _Box) -> str:
    """The file of a mesh."""
    return f"{index}_{CLASSES.index(box.name)}.obj"


def _load_mesh(result: Path, shapes: Mapping[str, _Shape], at: At) -> tuple[Mesh, str]:
    """The mesh of an object, as it is in the file."""
    return mesh_of(*shapes[at.value], At(None, at.value)), str((result / at.value).resolve())


def _load_image(source: Path, camera: Camera, warn: Warn) -> Float[Tensor, "h w 3"]:
    """The picture."""
    del warn
    return read_image(At("img.jpg", "input"), source, camera)


def _camera(source: Path, attitude: Path) -> At:
    """The fields of camera.json; p_total3d = cam_R @ (camera axes: forward, up, right)."""
    path = source / "cam_K.txt"
    try:
        K = np.atleast_2d(np.loadtxt(path))
    except (OSError, ValueError) as error:
        raise InputError(
            f"cam_K.txt: cannot be read ({reason(error)}), expected 3 x 3 numbers"
        ) from error
    array(At(K, path.name), (3, 3))
    bottom_and_skew = [K[0, 1], K[1, 0], *K[2]]
    if bottom_and_skew != [0, 0, 0, 0, 1]:
        refuse(At(K.tolist(), path.name), "intrinsics [fx 0 cx; 0 fy cy; 0 0 1]")
    R = TO_IMAGE @ _matrix(attitude, "cam_R", (3, 3)).T @ TO_OURS.T
    width, height = image_size(source / "img.jpg")
    return At(
        {
            "w": width, "h": height,
            "fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(),
            "cx": K[0, 2].item(), "cy": K[1, 2].item(),
            "R_cam_world": R.tolist(),
        },
        "cam_K.txt, r_ex.mat",
    )  # fmt: skip


def _detections(at: At) -> list[tuple[str, list[float]]]:
    """Class and corners of each detection [px]."""
    return [
        (choice(get(item, "class"), CLASSES), vector(get(item, "bbox"), 4)) for item in items(at)
    ]


def _annotations(rows: Sequence[tuple[str, list[float]]], kept: Sequence[int]) -> dict[str, Any]:
    """The content of objects.json; only boxes are known."""
    annotations: list[dict[str, Any]] = []
    for i in kept:
        name, (left, top, right, bottom) = rows[i]
        box = {"bbox": [left, top, right - left, bottom - top]}
        annotations.append({"id": i, "image_id": 0, "category_id": CLASSES.index(name), **box})
    categories = [{"id": i, "name": name} for i, name in enumerate(CLASSES)]
    return {"images": [{"id": 0}], "categories": categories, "annotations": annotations}


def _load_mat(path: Path) -> At:
    """The arrays of a MATLAB file."""
    from scipy.io import loadmat

    if not path.is_file():
        raise InputError(f"{path.name}: there is no such file in {path.parent}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return At(loadmat(str(path)), path.name)
    except Exception as error:  # the parser raises anything on broken files
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected a .mat file"
        ) from error


def _matrix(path: Path, key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A matrix of a MATLAB file."""
    return array(get(_load_mat(path), key), shape).astype(np.float64)


def _boxes(path: Path) -> list[_Box]:
    """All boxes, in the order of the detections."""
    content = _load_mat(path)
    cells = get(content, "bdb")
    if not isinstance(cells.value, np.ndarray) or cells.value.dtype != object:
        refuse(cells, "a cell of boxes")
    ids = array(get(content, "class_id"), (1, cells.value.size), "whole")[0]
    found: list[_Box] = []
    for i, (cell, key) in enumerate(zip(cells.value.ravel(), ids.tolist(), strict=True)):
        at = At(cell, content.file, f"bdb[{i}]")
        if not 0 <= key < len(CLASSES):
            refuse(get(content, "class_id"), f"ids from 0 to {len(CLASSES) - 1}", f"{key}")
        found.append(_box(at, CLASSES[key]))
    return found


def _box(at: At, name: str) -> _Box:
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
    return _Box(array(parts["centroid"], (1, 3)).astype(np.float64)[0], half, yaw, name)


def _piece(index: int, box: _Box, verts: NDArray[np.float64], floor: float) -> dict[str, Any]:
    """The fields of an object of scene.json; its mesh stays as it is in the file.

    The bounds that are stretched to the box are those of all vertices, used or not.
    """
    low, high = verts.min(0), verts.max(0)
    if (high <= low).any():
        refuse(At(None, _obj_name(index, box)), "a solid mesh", "a flat mesh")
    scale = 2 * box.half / (high - low)
    yaw = box.yaw + math.pi / 2  # TO_OURS is R_y of a quarter turn
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    place = TO_OURS @ box.center - R @ (scale * (low + high) / 2)
    lifted = box.name in LIFTED and box.center[1] - box.half[1] > floor + ON_FLOOR
    return {
        "id": f"{box.name}_{index}",
        "category": box.name,
        "mesh": _obj_name(index, box),
        "annotation": index,
        "translation": place.tolist(),
        "yaw": math.atan2(math.sin(yaw), math.cos(yaw)),
        "scale": scale.tolist(),
        "support": "free" if lifted else "ground",
    }


def _read_obj(path: Path) -> _Shape:
    """All vertices and triangles of an .obj, used or not."""
    if not path.is_file():
        raise InputError(f"{path.name}: there is no such file in {path.parent}, expected a mesh")
    lines = [line.split() for line in path.read_text(errors="replace").splitlines()]
    try:
        verts = np.array([line[1:4] for line in lines if line[:1] == ["v"]], dtype=np.float64)
        corners = [[c.split("/")[0] for c in line[1:]] for line in lines if line[:1] == ["f"]]
        faces = np.array(corners, dtype=np.int64).reshape(-1, 3) - 1
    except ValueError as error:
        raise InputError(f"{path.name}: has {error}, expected vertices and triangles") from error
    array(At(verts, path.name, "v"), ("V", 3))
    if not len(verts):
        raise InputError(f"{path.name}: has an empty mesh, expected vertices and triangles")
    return verts, faces
