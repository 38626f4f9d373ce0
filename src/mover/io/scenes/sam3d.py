"""SAM 3D Objects: a mesh for each mask, and its pose.

The tool gives a dictionary for each mask and writes no file of it, so that people save their own:
a folder with `<name>.glb` and beside each `<name>.npz` or `<name>.json` with `rotation` (w, x, y,
z), `translation` and `scale`. Meshes lie in a frame with +z up and are stored turned to +y up. The
pose leads to PyTorch3D's camera: x left, y up, z forward, with rows as vectors. Sizes are those of
the tool's depth, which may not be metric.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mover.core.errors import InputError
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts
from mover.io.files.cameras import GUESSED, read_camera_file, with_spread
from mover.io.files.fields import At, listed
from mover.io.files.images import image_size
from mover.io.files.looks import is_cloud, load_parts, looks_lost
from mover.io.files.meshes import KINDS
from mover.io.files.schema import rotation
from mover.io.people.values import TREES, numbers
from mover.io.scenes.placing import LEVEL, MOST_TILT, Matrix, Pieces, category_of_name, level_of

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
        found = f"{len(clouds)} files of points or splats, " if clouds else ""
        wanted = "expected <name>.glb with <name>.npz or .json"
        raise InputError(f"{folder}: has {found}no meshes, {wanted}")
    notes = [
        f"{listed('file', [p.name for p in passed])} {why}: passed over"
        for passed, why in (
            (clouds, "of points without faces, as Gaussian splats are"),
            ([p for p in meshes if p != once[p.stem]], "of the name of another mesh"),
        )
        if passed
    ]
    return [p for p in meshes if p == once[p.stem]], notes


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
