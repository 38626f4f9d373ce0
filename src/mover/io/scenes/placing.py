"""Objects that another tool placed by a matrix, as upright ones with yaw and scale."""

import math
import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.furniture.library import BACKS, BEDS, canonical
from mover.geometry.rotations import affine
from mover.io.capture.parts import UNKNOWN, Parts
from mover.io.capture.scene_file import scene_tree
from mover.io.files.fields import At, reason
from mover.io.files.meshes import check_gltf, mesh_of, read_mesh

EXACT = 1e-4  # [share], below it a matrix is a yaw and a scale
MOST_TILT = math.radians(30)  # a tool's error of an upright thing; beyond, the axes are others
SHEAR = 0.02  # [share], scales along axes that are not the object's own
FLIP = np.diag([1.0, -1.0, -1.0])
"""x right, y down, z forward <-> x right, y up, z backward; its own inverse."""
LEVEL = FLIP.tolist()
Matrix = NDArray[np.float64]
Placed = tuple[dict[str, Any], tuple[Mesh, str], str]
"""Fields of an object of scene.json, its mesh and file, and what was lost."""


@dataclass(frozen=True)
class FilePose:
    """The pose of a mesh in scene.json."""

    fields: dict[str, Any]
    """translation, yaw and scale of scene.json."""
    bake: Matrix | None
    """What its vertices must be multiplied with first (4, 4); None: they stay."""
    note: str
    """What was lost; empty: nothing."""


def posed(matrix: Matrix, low: Matrix, high: Matrix) -> FilePose:
    """The place of a mesh whose vertices a matrix takes into the world (+y up).

    Yaw and scale are kept as such. A small tilt is dropped about the centre of the box, since
    furniture stands upright. Anything else (other axes, shear, mirrors) goes into the vertices.

    Args:
        matrix: World from mesh (4, 4).
        low: Smallest corner of the mesh.
        high: Largest corner of the mesh.
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

    def add(self, category: str, name: str, place: Callable[[str], Placed]) -> None:
        """Append the object that `place` makes for a free id.

        Args:
            category: Free text.
            name: What the tool calls it.
            place: Fields of scene.json, the mesh with its file, and what was lost.
        """
        key = free_id(category, name, self.meshes)
        fields, self.meshes[key], note = place(key)
        self.notes.extend([f"{key}: {note}"] if note else [])
        self.rows.append({"id": key, "category": category, "mesh": key, **fields})

    def parts(self, name: str, file: str, ground: float | None = None) -> Parts:
        """Parts of a capture with these objects."""
        tree = scene_tree(self.rows, file, ground)
        load = partial(load_from, self.meshes)
        return Parts(name=name, scene=tree, load_mesh=load, notes=tuple(self.notes))


def _fields(t: Matrix, yaw: float, scale: Matrix) -> dict[str, Any]:
    return {"translation": t.tolist(), "yaw": yaw, "scale": scale.tolist()}


def level_of(up_cam: Matrix) -> Matrix:
    """R_cam_world of a camera that sees gravity so: `up_cam` points up in its axes."""
    up = up_cam / np.linalg.norm(up_cam)
    ahead = np.array([0.0, 0, 1]) - up * up[2]
    back = -ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    out: Matrix = np.empty((3, 3))
    out[:, 0], out[:, 1], out[:, 2] = np.cross(up, back), up, back
    return out


def common_up(ups: Sequence[Matrix]) -> Matrix | None:
    """The direction on which most objects agree that it is up; None: they do not."""
    if not ups:
        return None
    rows = np.stack(ups).astype(np.float64)
    lengths = np.maximum(np.sqrt((rows * rows).sum(axis=1, keepdims=True)), 1e-12)
    unit = rows / lengths
    close = unit @ unit.T > math.cos(MOST_TILT)
    best = close[int(close.sum(axis=1).argmax())]
    if 2 * best.sum() <= len(ups) and len(ups) > 1:
        return None
    return np.asarray(unit[best].mean(0), dtype=np.float64)


def corners(mesh: Mesh) -> tuple[Matrix, Matrix]:
    """Smallest and largest corner of a mesh."""
    verts = mesh.verts.double().numpy()
    return verts.min(0), verts.max(0)


def load_parts(path: Path) -> Any:  # noqa: ANN401
    """A mesh file with materials and textures, as trimesh has it.

    Raises:
        InputError: If it cannot be read, or names files outside of its folder.
    """
    import warnings

    import trimesh

    at = At(path.name, path.name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            check_gltf(at, path, pictures=True)
            return trimesh.load_scene(str(path), process=False)
        except InputError:
            raise
        except Exception as error:  # the parsers raise anything on broken files
            raise InputError(
                f"{path.name}: cannot be read ({reason(error)}), expected a mesh"
            ) from error


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


# Names of nodes and files as categories and ids.


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


# Where the front of a mesh is that has no axes of its own.


TURNS = 90  # angles that are tried for the box around a footprint, over a quarter turn
UPPER = 0.75  # [share of the height], above it a seat has only its back
CLEAR = 0.05  # [share of the size], a back that is so far off the middle is one


def guess_front(verts: NDArray[np.float64], category: str) -> float:
    """The yaw of a box around the points whose +z is most likely the front [rad].

    The box is the one with the smallest footprint. What has a back (chairs, sofas, beds with a
    headboard) turns it away from where its highest points are; all else faces the camera, as
    things along walls do.

    Args:
        verts: Points in the world: +y up, the camera at the origin.
        category: Free text.
    """
    flat = verts[:, [0, 2]]
    angles = np.arange(TURNS) * (math.pi / 2 / TURNS)
    x = flat @ np.stack([np.cos(angles), -np.sin(angles)])
    z = flat @ np.stack([np.sin(angles), np.cos(angles)])
    areas = np.ptp(x, axis=0) * np.ptp(z, axis=0)
    best = float(angles[int(areas.argmin())])
    centre = (flat.max(0) + flat.min(0)) / 2
    wanted = -centre  # towards the camera
    if canonical(category) in BACKS | BEDS:
        low, high = verts[:, 1].min(), verts[:, 1].max()
        top = flat[verts[:, 1] >= low + UPPER * (high - low)]
        off = (top.max(0) + top.min(0)) / 2 - centre
        if np.linalg.norm(off) > CLEAR * np.ptp(flat, axis=0).max():
            wanted = -off
    quarters = best + np.arange(4) * math.pi / 2
    towards = np.sin(quarters) * wanted[0] + np.cos(quarters) * wanted[1]
    yaw = float(quarters[int(towards.argmax())])
    return math.atan2(math.sin(yaw), math.cos(yaw))


def without_axes(path: Path, world: Matrix, category: str, file: Path, note: str = "") -> Placed:
    """The place of a mesh that lies where it is, and a copy about the middle of its box's bottom.

    Args:
        path: The mesh.
        world: Our world (+y up, the camera at the origin) from its vertices (4, 4).
        category: Free text.
        file: Where the copy goes.
        note: What was lost.
    """
    mesh, _ = read_mesh(At(path.name, path.name), path.parent)
    verts = mesh.verts.double().numpy() @ world[:3, :3].T + world[:3, 3]
    yaw = guess_front(verts, category)
    local = verts @ about_y(yaw)  # rows: R_y(-yaw) v
    low, high = local.min(0), local.max(0)
    origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    found = write_parts(load_parts(path), affine(about_y(-yaw), -origin) @ world, file)
    return _fields(about_y(yaw) @ origin, yaw, np.ones(3)), found, note
