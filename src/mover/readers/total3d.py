"""Total3D and Implicit3D (Im3D): picture, intrinsics, detections; camera, boxes, layout, meshes.

The files lie in input/ and output/, or all in one folder. The world has x forward, y up, z right,
and the camera at the origin. Boxes have half sizes and rows of axes; a mesh is stretched to its
box. The intrinsics belong to the tool's own pixel grid, which is taken as the image's: no half
pixel is added. Meshes are numbered like the detections; numbers are compared as numbers.
"""

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..records import InputError
from ..types import Camera, Capture, Mesh
from .any_camera import read_intrinsics
from .assemble import Sources, assemble
from .fields import At, Warn, choice, get, items, maybe, number, read_json, refuse, vector
from .image_file import image_size, read_image
from .instances import mask_code
from .mesh_file import mesh_of
from .nyu40 import CLASSES, FURNITURE, LIFTED
from .scene_file import FORMAT, VERSION
from .total3d_files import Box, Shape, find_mesh, matrix, read_boxes, read_shape

ON_FLOOR = 0.3  # [m], such a thing stands on the floor if its box ends so close above it
TO_OURS = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""x forward, y up, z right -> x right, y up, z backward."""
TO_IMAGE = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""x forward, y up, z right -> x right, y down, z forward."""


def read_total3d(folder: Path) -> Capture:
    """Read the input and the output of Total3D or Im3D for one picture.

    Raises:
        InputError: If a file is missing or wrong.
    """
    return assemble(total3d_sources(folder))


def total3d_sources(folder: Path) -> Sources:
    """What Total3D or Im3D knows of one picture.

    Raises:
        InputError: If a file is missing or wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected one of Total3D")
    parts = [folder / name for name in ("input", "output")]
    source, result = [part if part.is_dir() else folder for part in parts]
    at = read_json(source / "detections.json")
    rows = [choice(get(item, "class"), CLASSES) for item in items(at)]
    boxes = read_boxes(result / "bdb_3d.mat")
    floor = float(matrix(result / "layout.mat", "layout", (8, 3))[:, 1].min())
    if rows != [box.name for box in boxes]:
        found = f"{len(boxes)} boxes of {[b.name for b in boxes][:4]} ..."
        expected = "the classes of detections.json, in order"
        raise InputError(f"bdb_3d.mat: field 'class_id' has {found}, expected {expected}")
    kept = {i: box for i, box in enumerate(boxes) if box.name in FURNITURE}
    files = {i: find_mesh(result, i, box.name) for i, box in kept.items()}
    shapes = {path.name: read_shape(path) for path in files.values()}
    pieces = [_piece(i, box, files[i].name, shapes, floor) for i, box in kept.items()]
    scene = {"format": FORMAT, "version": VERSION, "ground": {"height": floor}, "objects": pieces}
    return Sources(
        name=folder.resolve().name,
        camera=_camera(source, result / "r_ex.mat"),
        scene=At(scene, result.name),
        objects=At(_annotations(items(at), list(kept)), "detections.json"),
        people=None,
        bodies=None,
        contacts=None,
        load_mesh=partial(_load_mesh, result, shapes),
        load_image=partial(_load_image, source),
        n_frames=None,
    )


def _load_mesh(result: Path, shapes: Mapping[str, Shape], at: At) -> tuple[Mesh, str]:
    """The mesh of an object, as it is in the file."""
    return mesh_of(*shapes[at.value], At(None, at.value)), str((result / at.value).resolve())


def _load_image(source: Path, camera: Camera, warn: Warn) -> Float[Tensor, "h w 3"]:
    """The picture."""
    del warn
    return read_image(At("img.jpg", "input"), source, camera)


def _camera(source: Path, attitude: Path) -> At:
    """The fields of camera.json; p_total3d = cam_R @ (camera axes: forward, up, right)."""
    K = read_intrinsics(source / "cam_K.txt")
    R = TO_IMAGE @ matrix(attitude, "cam_R", (3, 3)).T @ TO_OURS.T
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


def _annotations(rows: Sequence[At], kept: Sequence[int]) -> dict[str, Any]:
    """The content of objects.json: boxes, and scores and masks where the file has them."""
    annotations: list[dict[str, Any]] = []
    for i in kept:
        name, box = choice(get(rows[i], "class"), CLASSES), get(rows[i], "bbox")
        scored = isinstance(box.value, list) and len(box.value) == 5
        left, top, right, bottom, *score = vector(box, 5 if scored else 4)
        row: dict[str, Any] = {"id": i, "image_id": 0, "category_id": CLASSES.index(name)}
        row |= {"bbox": [left, top, right - left, bottom - top]}
        if score:
            row["score"] = number(At(score[0], box.file, f"{box.field}[4]"), 0, 1)
        mask = maybe(rows[i], "mask")
        annotations.append(row if mask is None else {**row, "segmentation": mask_code(mask)})
    categories = [{"id": i, "name": name} for i, name in enumerate(CLASSES)]
    return {"images": [{"id": 0}], "categories": categories, "annotations": annotations}


def _piece(
    index: int, box: Box, file: str, shapes: Mapping[str, Shape], floor: float
) -> dict[str, Any]:
    """The fields of an object of scene.json; its mesh stays as it is in the file.

    The bounds that are stretched to the box are those of all vertices, used or not.
    """
    verts: NDArray[np.float64] = shapes[file][0]
    low, high = verts.min(0), verts.max(0)
    if (high <= low).any():
        refuse(At(None, file), "a solid mesh", "a flat mesh")
    scale = 2 * box.half / (high - low)
    yaw = box.yaw + math.pi / 2  # TO_OURS is R_y of a quarter turn
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    place = TO_OURS @ box.center - R @ (scale * (low + high) / 2)
    lifted = box.name in LIFTED and box.center[1] - box.half[1] > floor + ON_FLOOR
    return {
        "id": f"{box.name}_{index}",
        "category": box.name,
        "mesh": file,
        "annotation": index,
        "translation": place.tolist(),
        "yaw": math.atan2(math.sin(yaw), math.cos(yaw)),
        "scale": scale.tolist(),
        "support": "free" if lifted else "ground",
    }
