"""Objects that another tool placed by a matrix, as upright ones with yaw and scale."""

import math
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.rotations import affine
from mover.io.capture.parts import UNKNOWN, Parts
from mover.io.capture.scene_file import scene_tree
from mover.io.files.fields import At, reason
from mover.io.files.meshes import mesh_of

EXACT = 1e-4  # [share], below it a matrix is a yaw and a scale
MOST_TILT = math.radians(30)  # a tool's error of an upright thing; beyond, the axes are others
SHEAR = 0.02  # [share], scales along axes that are not the object's own
FLIP = np.diag([1.0, -1.0, -1.0])
"""x right, y down, z forward <-> x right, y up, z backward; its own inverse."""
LEVEL = FLIP.tolist()
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class FilePose:
    """The pose of a mesh in scene.json."""

    fields: dict[str, Any]
    """translation, yaw and scale."""
    bake: Matrix | None
    """What its vertices must be multiplied with first (4, 4); None: they stay."""
    note: str
    """What was lost; empty: nothing."""


def posed(matrix: Matrix, low: Matrix, high: Matrix) -> FilePose:
    """The pose of a mesh between two corners that a matrix (4, 4) takes into the world (+y up).

    Yaw and scale are kept as such. A small tilt is dropped about the centre of the box, since
    furniture stands upright. Anything else (other axes, shear, mirrors) goes into the vertices.
    """
    A, t = matrix[:3, :3], matrix[:3, 3]
    size = float(np.abs(A).max())
    yaw = math.atan2(A[0, 2], A[2, 2]) if math.hypot(A[0, 2], A[2, 2]) > EXACT * size else 0.0
    rest = about_y(-yaw) @ A
    scale = np.diag(rest)
    if np.abs(rest - np.diag(scale)).max() <= EXACT * size and (scale > 0).all():
        return FilePose(_fields(t, yaw, scale), None, "")
    lengths = np.linalg.norm(A, axis=0)
    R = A / np.maximum(lengths, 1e-12)
    tilt = math.acos(float(np.clip(R[1, 1], -1, 1)))
    skewed = np.abs(R.T @ R - np.eye(3)).max() > SHEAR or np.linalg.det(A) <= 0
    if not skewed and tilt <= MOST_TILT:
        centre = (low + high) / 2
        place = A @ centre + t - about_y(yaw) @ (lengths * centre)
        return FilePose(_fields(place, yaw, lengths), None, f"a tilt of {math.degrees(tilt):.1f}°")
    return _baked(A, t, low, high)


def _baked(A: Matrix, t: Matrix, low: Matrix, high: Matrix) -> FilePose:
    """The matrix without its yaw in the vertices; the front is that axis which lies level."""
    axes = [A[:, 2], -A[:, 1], A[:, 0]]
    front = max(axes, key=lambda a: math.hypot(a[0], a[2]) / max(float(np.linalg.norm(a)), 1e-12))
    if math.hypot(A[0, 2], A[2, 2]) > 0.5 * float(np.linalg.norm(A[:, 2])):
        front = A[:, 2]
    yaw = math.atan2(front[0], front[2])
    turn = about_y(-yaw) @ A
    centre = turn @ ((low + high) / 2)
    bake = affine(turn, -centre)  # near its own origin, where single precision is finest
    place = t + about_y(yaw) @ centre
    mirrored = " mirrored" if np.linalg.det(A) < 0 else ""
    note = f"it was{mirrored} about other axes, which went into a new mesh"
    return FilePose(_fields(place, yaw, np.ones(3)), bake, note)


def about_y(angle: float) -> Matrix:
    """The right-handed rotation about +y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


@dataclass(frozen=True)
class Pieces:
    """Objects of scene.json that a reader finds, and their meshes by their ids."""

    rows: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    meshes: dict[str, tuple[Mesh, str]] = field(default_factory=dict[str, tuple[Mesh, str]])
    notes: list[str] = field(default_factory=list[str])

    def add(
        self, category: str, key: str, fields: Mapping[str, Any], mesh: Mesh, file: str
    ) -> None:
        """Append an object with a free id and its fields of scene.json."""
        self.meshes[key] = mesh, file
        self.rows.append({"id": key, "category": category, "mesh": key, **fields})

    def add_parts(self, category: str, name: str, scene: Any, matrix: Matrix, work: Path) -> None:  # noqa: ANN401
        """Append the object of parts that a matrix takes into the world; its file is in `work`."""
        key = free_id(category, name, self.meshes)
        found = write_parts(scene, np.eye(4), work / f"{key}.glb")
        verts = found[0].verts.double().numpy()
        pose = posed(matrix, verts.min(0), verts.max(0))
        if pose.bake is not None:
            found = write_parts(scene, pose.bake, work / f"{key}.glb")
        if pose.note:
            self.notes.append(f"{key}: {pose.note}")
        self.add(category, key, pose.fields, *found)

    def parts(self, name: str, file: str, ground: float | None = None) -> Parts:
        """Parts of a capture with these objects."""
        load, tree = partial(load_from, self.meshes), scene_tree(self.rows, file, ground)
        return Parts(name=name, scene=tree, load_mesh=load, notes=tuple(self.notes))


def _fields(t: Matrix, yaw: float, scale: Matrix) -> dict[str, Any]:
    return {"translation": t.tolist(), "yaw": yaw, "scale": scale.tolist()}


def level_of(up_cam: Matrix) -> Matrix:
    """R_cam_world of a camera that sees gravity so: `up_cam` points up in its axes."""
    up = torch.from_numpy(up_cam / np.linalg.norm(up_cam))
    return tilted(*pitch_roll(torch.stack([up, up, up], 1))).numpy()


def write_parts(scene: Any, matrix: Matrix, path: Path) -> tuple[Mesh, str]:  # noqa: ANN401
    """Write parts under a transform as .glb, textures included; the mesh and its file.

    Raises:
        InputError: If it has no triangles or cannot be written.
    """
    import trimesh

    try:
        moved = trimesh.Scene()
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            part = scene.geometry[name]
            if isinstance(part, trimesh.Trimesh):
                moved.add_geometry(part.copy().apply_transform(matrix @ transform), node_name=node)
        path.parent.mkdir(parents=True, exist_ok=True)
        content: Any = moved.export(file_type="glb")
        path.write_bytes(content)
        whole = moved.to_mesh()
    except Exception as error:  # broken textures, empty scenes
        raise InputError(
            f"{path.stem}: has a mesh that cannot be written ({reason(error)}), expected triangles"
        ) from error
    at = At(path.stem, path.name)
    return mesh_of(np.asarray(whole.vertices), np.asarray(whole.faces), at), str(path)


def load_from(meshes: Mapping[str, tuple[Mesh, str]], at: At) -> tuple[Mesh, str]:
    """The mesh of this name among those that a reader holds."""
    return meshes[at.value]


SAFE = re.compile(r"[^\w.-]+")


def category_of_name(name: str) -> str:
    """`dining table` of dining_table_2, 3_dining_table, `Dining Table.001`."""
    words = re.sub(r"[_\-.]+", " ", name).split()
    plain = [w for w in words if not w.isdecimal() and w.lower() not in ("mesh", "geometry")]
    return " ".join(plain) or UNKNOWN


def free_id(category: str, name: str, used: Container[str]) -> str:
    """An id that scene.json takes: of the name, else of the category and a number."""
    plain = SAFE.sub("_", name).strip("._- ")
    if not plain or plain.isdecimal():
        plain = f"{SAFE.sub('_', category).strip('._- ') or UNKNOWN}_{plain or 0}"
    if plain.casefold() in ("ground", "free"):
        plain = f"{plain}_0"
    plain, number = plain[:80], 1
    taken = plain
    while taken in used:
        taken, number = f"{plain}_{number}", number + 1
    return taken
