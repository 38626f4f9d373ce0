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
from typing import Any

import numpy as np

from ..records import InputError
from ..types import Mesh
from .any_camera import read_camera_file
from .fields import At, maybe, rotation, text
from .fronts import without_axes
from .mesh_file import KINDS, read_mesh
from .parts import UNKNOWN, Hints, Parts
from .placing import (
    LEVEL,
    Matrix,
    common_up,
    corners,
    level_of,
    load_from,
    load_parts,
    posed,
    write_parts,
)
from .sam3d_people import person_parts
from .sam3d_poses import placed_already, pose_beside, pose_matrix, poses_of
from .scene_file import FORMAT, VERSION
from .words import category_of_name, free_id

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
        camera = read_camera_file(lens, _size(hints))
    things = _things(folder, hints)
    if not things:
        raise InputError(f"{folder}: has no meshes, expected <name>.glb with <name>.npz or .json")
    R, how = _attitude(camera, things)
    rows, meshes, notes = _pieces(things, R, hints.work)
    scene = At({"format": FORMAT, "version": VERSION, "objects": rows}, folder.name)
    if camera is not None:
        camera = At({**camera.value, "R_cam_world": R.tolist()}, camera.file)
    people = person_parts(folder)
    return dataclasses.replace(
        people,
        name=folder.resolve().name,
        camera=camera,
        scene=scene,
        load_mesh=partial(load_from, meshes),
        notes=(how, *notes, *people.notes),
    )


def _size(hints: Hints) -> tuple[int, int] | None:
    from .image_file import image_size

    return None if hints.image is None else image_size(hints.image)


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
        matrix = placed_already() if pose is None else pose_matrix(pose)
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
    placed = placed_already()
    ups = [t.cam_mesh[:3, 1] for t in things if not np.array_equal(t.cam_mesh, placed)]
    up = common_up(ups)
    if up is None:
        return np.array(LEVEL), "the camera's tilt is not known: taken as level"
    return level_of(up), "the camera's tilt is that at which most objects stand upright"


def _pieces(
    things: list[_Thing], R: Matrix, work: Path
) -> tuple[list[dict[str, Any]], dict[str, tuple[Mesh, str]], list[str]]:
    """Objects of scene.json, their meshes, and what was lost."""
    rows: list[dict[str, Any]] = []
    meshes: dict[str, tuple[Mesh, str]] = {}
    notes: list[str] = []
    turn = np.eye(4)
    turn[:3, :3] = R.T
    for thing in things:
        name = free_id(thing.category, thing.name, meshes)
        fields, meshes[name], note = _placed_piece(thing, turn, work / f"{name}.glb")
        notes += [f"{name}: {note}"] if note else []
        category = thing.category or UNKNOWN
        rows.append({"id": name, "category": category, "mesh": name, **fields})
    return rows, meshes, notes


def _check_placed(thing: _Thing) -> None:
    """Refuse a mesh in its own frame: one that was placed lies before the camera."""
    ahead = -thing.mesh.verts[:, 2]
    if float(ahead.median()) < NEAREST:
        where = "has no pose and does not lie before the camera"
        expected = f"{thing.name}.npz or {thing.name}.json beside it"
        raise InputError(f"{thing.file.name}: {where}, expected {expected}")


def _placed_piece(
    thing: _Thing, turn: Matrix, file: Path
) -> tuple[dict[str, Any], tuple[Mesh, str], str]:
    """The place of a mesh, the mesh, and what was lost."""
    matrix = turn @ thing.cam_mesh
    if np.array_equal(thing.cam_mesh, placed_already()):
        _check_placed(thing)
        fields, mesh = without_axes(thing.file, matrix, thing.category, file)
        return fields, mesh, "it was placed already; its front is a guess"
    found = posed(matrix, *corners(thing.mesh))
    mesh = thing.mesh, str(thing.file.resolve())
    if found.bake is not None:
        mesh = write_parts(load_parts(thing.file), found.bake, file)
    return found.fields, mesh, found.note
