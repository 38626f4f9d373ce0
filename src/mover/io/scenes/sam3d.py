"""SAM 3D Objects: a mesh for each mask, and its pose; and what its notebooks make of people.

The tool gives a dictionary for each mask and writes no file of it, so that people save their own:
a folder with `<name>.glb` and beside each `<name>.npz` or `<name>.json` with `rotation` (w, x, y,
z), `translation` and `scale`; or one poses.json / poses.npz for all. A mesh without a pose is one
that the notebooks have placed already, in the axes of an OpenGL camera. Meshes lie in a frame with
+z up and are stored turned to +y up. The pose leads to PyTorch3D's camera: x left, y up, z
forward, with rows as vectors. Sizes are those of the tool's depth, which may not be metric.
"""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts
from mover.io.files.cameras import GUESSED, read_camera_file, with_spread
from mover.io.files.fields import At, array, get, mapping, maybe, number, read_json, refuse, text
from mover.io.files.images import image_size
from mover.io.files.meshes import KINDS, read_mesh
from mover.io.files.npz import read_npz
from mover.io.files.schema import rotation
from mover.io.scenes.placing import (
    FLIP,
    LEVEL,
    Matrix,
    Pieces,
    Placed,
    category_of_name,
    common_up,
    corners,
    level_of,
    load_parts,
    posed,
    without_axes,
    write_parts,
)

TO_LOCAL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The stored mesh (+y up) -> the frame of the pose (+z up)."""
TO_OPENCV = np.diag([-1.0, -1.0, 1.0])
"""PyTorch3D's camera (x left, y up) -> x right, y down."""
TOGETHER = ("rotation", "translation", "scale")


def pose_beside(path: Path) -> At | None:
    """The pose beside a mesh, None where there is none."""
    for kind in (".npz", ".json"):
        own = path.with_suffix(kind)
        if own.is_file():
            return _listed(read_npz(own) if kind == ".npz" else read_json(own))
    return None


def poses_of(path: Path) -> dict[str, At]:
    """Poses by name; a list is in the order of the masks, and so are the rows of arrays."""
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
    """Camera from mesh (4, 4): rows v, ((v @ L.T) * scale) @ R(q) + t, then x and y turned."""
    from scipy.spatial.transform import Rotation

    q = _numbers(get(at, "rotation"), 4)
    if not 0.5 < float(np.linalg.norm(q)) < 2:
        refuse(get(at, "rotation"), "a unit quaternion (w, x, y, z)")
    R = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    given = get(at, "scale")
    scale = np.array([number(given)] * 3) if isinstance(given.value, int | float) else None
    scale = _numbers(given, 3) if scale is None else scale
    if (scale <= 0).any():
        refuse(given, "scales above 0")
    turn = TO_OPENCV @ R.T @ np.diag(scale) @ TO_LOCAL
    return affine(turn, TO_OPENCV @ _numbers(get(at, "translation"), 3))


PLACED = affine(FLIP)
"""Camera from mesh of what is already in an OpenGL camera's axes."""


# People whom SAM 3D's notebooks leave beside the objects: human.ply in an OpenGL camera's axes.


NAMES = ("human_aligned", "human", "person", "body")


def person_parts(folder: Path) -> Parts:
    """The person of a folder as one body in frame 0; nothing where there is none.

    The notebook of the human alignment scales the person to the depth in which the objects were
    made and shifts it to its mask; such a mesh (human_aligned) comes first.
    """
    for name in NAMES:
        for path in sorted(p for kind in KINDS for p in folder.glob(f"{name}*{kind}")):
            mesh, _ = read_mesh(At(path.name, path.name), folder)
            arrays = {
                "vertices": (mesh.verts.double().numpy() @ FLIP)[None].astype(np.float32),
                "faces": mesh.faces.numpy(),
                "frame": np.zeros(1, dtype=np.int64),
                "person": np.zeros(1, dtype=np.int64),
                "space": np.array("camera"),
            }
            note = f"{path.name} is the person of frame 0"
            return Parts(name=folder.name, bodies=At(arrays, path.name), notes=(note,))
    return Parts(name=folder.name)


NEAREST = 0.2  # [m], nothing in a picture of a room is nearer
POSES = ("poses.json", "poses.npz", "pose.json")


@dataclasses.dataclass(frozen=True)
class _Thing:
    """A mesh in the camera's axes (x right, y down, z forward)."""

    name: str
    category: str
    mesh: Mesh
    file: Path
    cam_mesh: Matrix
    """(4, 4)."""


def sam3d_parts(folder: Path, hints: Hints) -> Parts:
    """Objects, and a person where there is one, of a folder of SAM 3D's results.

    Raises:
        InputError: If a pose or a mesh is wrong, or the camera is not known.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected results of SAM 3D Objects")
    lens = folder / "focal_length.json"
    camera = hints.camera
    if camera is None and lens.is_file():
        size = None if hints.image is None else image_size(hints.image)
        camera = with_spread(read_camera_file(lens, size), GUESSED)
    things = _things(folder, hints)
    if not things:
        raise InputError(f"{folder}: has no meshes, expected <name>.glb with <name>.npz or .json")
    R, how = _attitude(camera, things)
    turn = affine(R.T)
    found = Pieces()
    for thing in things:
        found.add(thing.category, thing.name, partial(_placed_piece, thing, turn, hints.work))
    if camera is not None:
        camera = At({**camera.value, "R_cam_world": R.tolist()}, camera.file)
    people = person_parts(folder)
    return dataclasses.replace(
        found.parts(folder.resolve().name, folder.name),
        camera=camera,
        bodies=people.bodies,
        notes=(how, *found.notes, *people.notes),
    )


def _things(folder: Path, hints: Hints) -> list[_Thing]:
    """Meshes with their poses, in the order of their names, numbers as numbers."""
    shared = next((path for name in POSES if (path := folder / name).is_file()), None)
    poses = {} if shared is None else poses_of(shared)
    found: list[_Thing] = []
    paths = [p for p in folder.iterdir() if p.suffix.lower() in KINDS and not _is_person(p)]
    for path in sorted(paths, key=lambda p: (len(p.stem), p.stem) if p.stem.isdecimal() else
                       (0, p.stem)):  # fmt: skip
        mesh, _ = read_mesh(At(path.name, path.name), folder)
        pose = poses.get(path.stem) or pose_beside(path)
        matrix = PLACED if pose is None else pose_matrix(pose)
        name = hints.names.get(path.stem) or _category(pose) or category_of_name(path.stem)
        found.append(_Thing(path.stem, name, mesh, path, matrix))
    return found


def _is_person(path: Path) -> bool:
    return path.stem.lower().startswith(("human", "person", "body"))


def _category(pose: At | None) -> str | None:
    """What the user wrote beside the pose."""
    for key in ("category", "label", "class"):
        if pose is not None and (found := maybe(pose, key)) is not None:
            return text(found)
    return None


def _attitude(camera: At | None, things: list[_Thing]) -> tuple[Matrix, str]:
    """R_cam_world: given, or from the objects that stand upright, or level."""
    given = None if camera is None else maybe(camera, "R_cam_world")
    if given is not None:
        return rotation(given), "the camera's tilt is the one that was given"
    ups = [t.cam_mesh[:3, 1] for t in things if not np.array_equal(t.cam_mesh, PLACED)]
    up = common_up(ups)
    if up is None:
        return np.array(LEVEL), "the camera's tilt is not known: taken as level"
    return level_of(up), "the camera's tilt is that at which most objects stand upright"


def _check_placed(thing: _Thing) -> None:
    """Refuse a mesh in its own frame: one that was placed lies before the camera."""
    ahead = -thing.mesh.verts[:, 2]
    if float(ahead.median()) < NEAREST:
        where = "has no pose and does not lie before the camera"
        expected = f"{thing.name}.npz or {thing.name}.json beside it"
        raise InputError(f"{thing.file.name}: {where}, expected {expected}")


def _placed_piece(thing: _Thing, turn: Matrix, work: Path, key: str) -> Placed:
    matrix, copy = turn @ thing.cam_mesh, work / f"{key}.glb"
    if np.array_equal(thing.cam_mesh, PLACED):
        _check_placed(thing)
        note = "it was placed already; its front is a guess"
        return without_axes(thing.file, matrix, thing.category, copy, note)
    found = posed(matrix, *corners(thing.mesh))
    mesh = thing.mesh, str(thing.file.resolve())
    if found.bake is not None:
        mesh = write_parts(load_parts(thing.file), found.bake, copy)
    return found.fields, mesh, found.note
