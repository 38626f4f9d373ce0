"""Networks from one image to meshes: Total3D and Implicit3D (Im3D), SAM 3D Objects.

Total3D: the files lie in input/ and output/, or all in one folder. The world has x forward, y up, z
right, and the camera at the origin. Boxes have half sizes and rows of axes; a mesh is stretched to
its box. The intrinsics belong to the tool's own pixel grid, which is taken as the image's: no half
pixel is added. Meshes are numbered like the detections; numbers are compared as numbers.

SAM 3D Objects: the tool gives a dictionary for each mask and writes no file of it, so that people
save their own: a folder with `<name>.glb` and beside each `<name>.npz` or `<name>.json` with
`rotation` (w, x, y, z), `translation` and `scale`. Meshes lie in a frame with +z up and are stored
turned to +y up. The pose leads to PyTorch3D's camera: x left, y up, z forward, with rows as
vectors. Sizes are those of the tool's depth, which may not be metric.
"""

import dataclasses
import math
import pickle
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Capture, Mesh
from mover.geometry.rotations import affine
from mover.io.capture.folder import build_capture
from mover.io.capture.parts import Hints, Parts
from mover.io.capture.scene_file import scene_tree
from mover.io.files.cameras import GUESSED, read_camera_file, read_intrinsics, with_spread
from mover.io.files.fields import At, existing, listed, read_json
from mover.io.files.images import image_size, read_image
from mover.io.files.meshes import KINDS, is_cloud, load_parts, looks_lost, mesh_of, read_mesh
from mover.io.files.schema import rotation
from mover.io.masks.coco import annotations_tree
from mover.io.masks.instances import mask_code
from mover.io.people.values import TREES, numbers
from mover.io.scenes.placing import (
    LEVEL,
    MOST_TILT,
    Matrix,
    Pieces,
    about_y,
    category_of_name,
    level_of,
)

CLASSES = (
    "void", "wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window",
    "bookshelf", "picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser",
    "pillow", "mirror", "floor_mat", "clothes", "ceiling", "books", "refridgerator",
    "television", "paper", "towel", "shower_curtain", "box", "whiteboard", "person",
    "night_stand", "toilet", "sink", "lamp", "bathtub", "bag", "otherstructure",
    "otherfurniture", "otherprop",
)  # fmt: skip
"""NYU40's names, by class id."""
FURNITURE = (
    "cabinet", "bed", "chair", "sofa", "table", "bookshelf", "counter", "desk", "shelves",
    "dresser", "refridgerator", "television", "box", "night_stand", "toilet", "sink", "lamp",
    "bathtub", "otherfurniture",
)  # fmt: skip
"""Those that stand in a room and are worth placing."""
LIFTED = ("television", "box", "sink", "lamp")
"""What may stand on something else or hang on a wall."""
ON_FLOOR = 0.3  # [m], such a thing stands on the floor if its box ends so close above it
TO_OURS = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
"""x forward, y up, z right -> x right, y up, z backward."""
TO_IMAGE = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""x forward, y up, z right -> x right, y down, z forward."""
READ = """
import pickle, sys, warnings
from scipy.io import loadmat
warnings.simplefilter("ignore")
try:
    said = loadmat(sys.argv[1])
except Exception as error:  # the parser raises anything on broken files
    said = " ".join(f"{type(error).__name__}: {error}".split())[:160]
sys.stdout.buffer.write(pickle.dumps(said))
"""
"""Writes the arrays of a MATLAB file, or the error in one line: scipy's reader can die of one."""
Shape = tuple[NDArray[np.float64], NDArray[np.int64]]
"""All vertices and triangles of a mesh, used or not."""


@dataclass(frozen=True)
class TotalBox:
    """A box of bdb_3d.mat in Total3D's world."""

    center: NDArray[np.float64]
    half: NDArray[np.float64]
    yaw: float
    name: str


def load_mat(path: Path) -> At:
    """The arrays of a MATLAB file, read in a process of its own."""
    existing(path)
    call = [sys.executable, "-P", "-c", READ, str(path.resolve())]
    done = subprocess.run(call, capture_output=True, check=False)
    said = pickle.loads(done.stdout) if done.returncode == 0 else "its reader died"
    if isinstance(said, str):
        raise InputError(f"{path.name}: cannot be read ({said}), expected a .mat file")
    return At(said, path.name)


def matrix(path: Path, key: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    """A matrix of a MATLAB file."""
    return load_mat(path).get(key).array(shape).astype(np.float64)


def read_boxes(path: Path) -> list[TotalBox]:
    """All boxes, in the order of the detections."""
    content = load_mat(path)
    cells = content.get("bdb")
    if not isinstance(cells.value, np.ndarray) or cells.value.dtype != object:
        cells.refuse("a cell of boxes")
    ids = content.get("class_id").array((1, cells.value.size), "whole")[0]
    found: list[TotalBox] = []
    for i, (cell, key) in enumerate(zip(cells.value.ravel(), ids.tolist(), strict=True)):
        at = At(cell, content.file, f"bdb[{i}]")
        if not 0 <= key < len(CLASSES):
            content.get("class_id").refuse(f"ids from 0 to {len(CLASSES) - 1}", f"{key}")
        found.append(_box(at, CLASSES[key]))
    return found


def _box(at: At, name: str) -> TotalBox:
    """One box: its axes are the rows of `basis`, upright; p = p_local @ basis + centroid."""
    one = isinstance(at.value, np.ndarray) and at.value.size == 1
    names = at.value.dtype.names if one else None
    if not names or not {"basis", "coeffs", "centroid"} <= set(names):
        at.refuse("a struct with basis, coeffs, centroid")
    struct = at.value.ravel()[0]
    parts = {key: At(struct[key], at.file, f"{at.field}.{key}") for key in names}
    basis = parts["basis"].array((3, 3)).astype(np.float64)
    half = parts["coeffs"].array((1, 3)).astype(np.float64)[0]
    if (half <= 0).any():
        parts["coeffs"].refuse("half sizes above 0", f"{half.tolist()}")
    yaw = math.atan2(basis[2, 0], basis[2, 2])
    if abs(basis - about_y(-yaw)).max() > 1e-3:
        parts["basis"].refuse("the axes of an upright box", f"{basis.round(3).tolist()}")
    return TotalBox(parts["centroid"].array((1, 3)).astype(np.float64)[0], half, yaw, name)


def find_mesh(folder: Path, index: int, name: str) -> Path:
    """The mesh of a box: `<index>_<class id>.obj`, or another kind of mesh with this name."""
    stem = f"{index}_{CLASSES.index(name)}"
    found = (path for kind in (".obj", *KINDS) if (path := folder / (stem + kind)).is_file())
    path = next(found, None)
    if path is None:
        raise InputError(f"{stem}.obj: there is no such file in {folder}, expected a mesh")
    return path


def read_shape(path: Path) -> Shape:
    """All vertices and triangles of a mesh; of an .obj also those vertices that are not used."""
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
    At(verts, path.name, "v").array(("V", 3))
    if not len(verts):
        raise InputError(f"{path.name}: has an empty mesh, expected vertices and triangles")
    return verts, faces


def read_total3d(folder: Path) -> Capture:
    """Read the input and the output of Total3D or Im3D for one picture."""
    return build_capture(total3d_parts(folder, Hints()))


def total3d_parts(folder: Path, hints: Hints) -> Parts:
    """What Total3D or Im3D knows of one picture."""
    del hints
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected one of Total3D")
    parts = [folder / name for name in ("input", "output")]
    source, result = [part if part.is_dir() else folder for part in parts]
    at = read_json(source / "detections.json")
    names = [item.get("class").choice(CLASSES) for item in at.items()]
    boxes = read_boxes(result / "bdb_3d.mat")
    box = matrix(result / "layout.mat", "layout", (8, 3))  # the upper four corners, the lower four
    floor = float(box[:, 1].min())
    if names != [box.name for box in boxes]:
        found = f"{len(boxes)} boxes of {[b.name for b in boxes][:4]} ..."
        at = At(names, "bdb_3d.mat", "class_id")
        at.refuse("the classes of detections.json, in order", found)
    kept = {i: box for i, box in enumerate(boxes) if box.name in FURNITURE}
    files = {i: find_mesh(result, i, box.name) for i, box in kept.items()}
    shapes = {path.name: read_shape(path) for path in files.values()}
    rows = [_object(i, box, files[i].name, shapes, floor) for i, box in kept.items()]

    def load(at: At) -> tuple[Mesh, str]:  # as it is in the file
        return mesh_of(*shapes[at.value], At(None, at.value)), str((result / at.value).resolve())

    return Parts(
        name=folder.resolve().name, camera=_camera(source, result / "r_ex.mat"),
        scene=scene_tree(rows, result.name, floor),
        objects=At(_annotations(at.items(), list(kept)), "detections.json"), load_mesh=load,
        load_image=partial(read_image, At("img.jpg", "input"), source),
    )  # fmt: skip


def _camera(source: Path, attitude: Path) -> At:
    """The fields of camera.json; p_total3d = cam_R @ (camera axes: forward, up, right)."""
    K = read_intrinsics(source / "cam_K.txt").tolist()
    R = TO_IMAGE @ matrix(attitude, "cam_R", (3, 3)).T @ TO_OURS.T
    width, height = image_size(source / "img.jpg")
    lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    fields = {"w": width, "h": height, **lens, "R_cam_world": R.tolist()}
    return At(fields, "cam_K.txt, r_ex.mat")


def _annotations(rows: Sequence[At], kept: Sequence[int]) -> dict[str, Any]:
    """The content of objects.json: boxes, and scores and masks where the file has them."""
    annotations: list[dict[str, Any]] = []
    for i in kept:
        name, box = rows[i].get("class").choice(CLASSES), rows[i].get("bbox")
        scored = isinstance(box.value, list) and len(box.value) == 5
        left, top, right, bottom, *score = box.vector(5 if scored else 4)
        row: dict[str, Any] = {"id": i, "image_id": 0, "category_id": name}
        row |= {"bbox": [left, top, right - left, bottom - top]}
        if score:
            row["score"] = At(score[0], box.file, f"{box.field}[4]").number(0, 1)
        mask = rows[i].maybe("mask")
        annotations.append(row if mask is None else {**row, "segmentation": mask_code(mask)})
    return annotations_tree(annotations, {}, CLASSES)


def _object(
    index: int, box: TotalBox, file: str, shapes: Mapping[str, Shape], floor: float
) -> dict[str, Any]:
    """The fields of an object whose mesh is stretched by all its vertices, used or not."""
    verts: NDArray[np.float64] = shapes[file][0]
    low, high = verts.min(0), verts.max(0)
    if (high <= low).any():
        At(None, file).refuse("a solid mesh", "a flat mesh")
    scale = 2 * box.half / (high - low)
    yaw = box.yaw + math.pi / 2  # TO_OURS is R_y of a quarter turn
    place = TO_OURS @ box.center - about_y(yaw) @ (scale * (low + high) / 2)
    lifted = box.name in LIFTED and box.center[1] - box.half[1] > floor + ON_FLOOR
    return {
        "id": f"{box.name}_{index}", "category": box.name, "mesh": file, "annotation": index,
        "translation": place.tolist(), "yaw": math.atan2(math.sin(yaw), math.cos(yaw)),
        "scale": scale.tolist(), "support": "free" if lifted else "ground",
    }  # fmt: skip


TO_LOCAL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The stored mesh (+y up) -> the frame of the pose (+z up)."""
TO_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""PyTorch3D's camera (x left, y up) -> x right, y down."""
PEOPLE = ("human", "person", "body")
"""Names of meshes that are people, in folders of the tool's notebooks."""


def sam3d_parts(folder: Path, hints: Hints) -> Parts:
    """Objects of a folder of SAM 3D's results.

    Raises:
        InputError: If a pose or a mesh is wrong, or the camera is not known.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected results of SAM 3D Objects")
    lens, camera = folder / "focal_length.json", hints.camera
    if camera is None and lens.is_file():
        size = None if hints.image is None else image_size(hints.image)
        camera = with_spread(read_camera_file(lens, size), GUESSED)
    paths, notes = _things(folder)
    poses = [_pose_beside(path) for path in paths]
    matrices = [pose_matrix(pose) for pose in poses]
    R, how = _attitude(camera, matrices)
    found = Pieces()
    for path, pose, matrix in zip(paths, poses, matrices, strict=True):
        words = (pose.maybe(key) for key in ("category", "label", "class"))
        said = next((at.text() for at in words if at is not None), None)
        name = hints.names.get(path.stem) or said or category_of_name(path.stem)
        parts = load_parts(At(path.name, folder.name), path)
        found.add_parts(name, path.stem, parts, affine(R.T) @ matrix, hints.work)
        notes += [lost] if (lost := looks_lost(path)) else []
    if camera is not None:
        camera = At({**camera.value, "R_cam_world": R.tolist()}, camera.file)
    return dataclasses.replace(
        found.parts(folder.resolve().name, folder.name),
        camera=camera,
        notes=(how, *notes, *found.notes),
    )


def _things(folder: Path) -> tuple[list[Path], list[str]]:
    """The meshes of a folder, by number or name, and what is passed over."""
    kinds = {kind: rank for rank, kind in enumerate(KINDS)}
    paths = [path for path in folder.iterdir() if path.suffix.lower() in kinds]
    paths = [path for path in paths if not path.stem.lower().startswith(PEOPLE)]
    length = {p: len(p.stem) if p.stem.isdecimal() else 0 for p in paths}
    paths.sort(key=lambda p: (length[p], p.stem, kinds[p.suffix.lower()]))
    clouds = [path for path in paths if is_cloud(path)]
    meshes = [path for path in paths if path not in clouds]
    once = {path.stem: path for path in reversed(meshes)}  # the first of each name
    if not once:
        found = f"{listed('file', [p.name for p in clouds])} of splats, " if clouds else ""
        wanted = "expected <name>.glb with <name>.npz or .json"
        raise InputError(f"{folder}: has {found}no meshes, {wanted}")
    posed = {p for p in once.values() if any(p.with_suffix(kind).is_file() for kind in TREES)}
    bare = [] if not posed else [p for p in once.values() if p not in posed]
    notes = [
        f"{listed('file', [p.name for p in passed])} {why}: passed over"
        for passed, why in (
            (clouds, "of points without faces, as Gaussian splats are"),
            ([p for p in meshes if p != once[p.stem]], "of the name of another mesh"),
            (bare, "without a pose (.npz or .json) beside it"),
        )
        if passed
    ]
    return [p for p in meshes if p == once[p.stem] and p not in bare], notes


def _pose_beside(path: Path) -> At:
    """The pose beside a mesh, arrays as lists."""
    for kind, read in TREES.items():
        own = path.with_suffix(kind)
        if own.is_file():
            at = read(own)
            fields = at.mapping().items()
            plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in fields}
            return at.holding(plain)
    wanted = f"{path.stem}.npz or {path.stem}.json beside it"
    raise InputError(f"{path.name}: has no pose, expected {wanted}")


def pose_matrix(at: At) -> Matrix:
    """Camera from mesh (4, 4): rows v, ((v @ L.T) * scale) @ R(q) + t, then x and y turned."""
    from scipy.spatial.transform import Rotation

    q = _numbers(at.get("rotation"), 4)
    if not 0.5 < float(np.linalg.norm(q)) < 2:
        at.get("rotation").refuse("a unit quaternion (w, x, y, z)")
    R = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    given = at.get("scale")
    one = isinstance(given.value, int | float)
    scale = np.array([given.number()] * 3) if one else _numbers(given, 3)
    if (scale <= 0).any():
        given.refuse("scales above 0")
    turn = TO_OPENCV @ R.T @ np.diag(scale) @ TO_LOCAL
    return affine(turn, TO_OPENCV @ _numbers(at.get("translation"), 3))


def _numbers(at: At, count: int) -> Matrix:
    """`count` numbers in any nesting."""
    return at.holding(numbers(at).reshape(-1)).array((count,))


def _attitude(camera: At | None, matrices: Sequence[Matrix]) -> tuple[Matrix, str]:
    """R_cam_world: given, or that at which most objects stand upright, or level."""
    given = None if camera is None else camera.maybe("R_cam_world")
    if given is not None:
        return rotation(given), "the camera's tilt is the one that was given"
    ups = np.stack([matrix[:3, 1] for matrix in matrices])
    ups = ups / np.maximum(np.linalg.norm(ups, axis=1, keepdims=True), 1e-12)
    close = ups @ ups.T > math.cos(MOST_TILT)
    best = close[int(close.sum(axis=1).argmax())]
    if 2 * best.sum() <= len(ups) and len(ups) > 1:
        return np.array(LEVEL), "the camera's tilt is not known: taken as level"
    how = "the camera's tilt is that at which most objects stand upright"
    return level_of(ups[best].mean(0)), how
