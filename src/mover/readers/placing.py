"""Objects that another tool placed by a matrix, as upright pieces with yaw and scale."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import InputError
from ..types import Mesh
from .fields import At, reason
from .mesh_file import check_gltf, mesh_of

EXACT = 1e-4  # [share], below it a matrix is a yaw and a scale
MOST_TILT = math.radians(30)  # a tool's error of an upright thing; beyond, the axes are others
SHEAR = 0.02  # [share], scales along axes that are not the object's own
FLIP = np.diag([1.0, -1.0, -1.0])
"""x right, y down, z forward <-> x right, y up, z backward; its own inverse."""
LEVEL = FLIP.tolist()
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Posed:
    """A mesh and its place."""

    fields: dict[str, Any]
    """translation, yaw and scale of scene.json."""
    bake: Matrix | None
    """What its vertices must be multiplied with first (4, 4); None: they stay."""
    note: str
    """What was lost; empty: nothing."""


def posed(matrix: Matrix, low: Matrix, high: Matrix) -> Posed:
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
    rest = _about_y(-yaw) @ A
    scale = np.diag(rest)
    if np.abs(rest - np.diag(scale)).max() <= EXACT * size and (scale > 0).all():
        return Posed(_fields(t, yaw, scale), None, "")
    lengths = np.linalg.norm(A, axis=0)
    R = A / np.maximum(lengths, 1e-12)
    tilt = math.acos(float(np.clip(R[1, 1], -1, 1)))
    skewed = np.abs(R.T @ R - np.eye(3)).max() > SHEAR or np.linalg.det(A) <= 0
    if not skewed and tilt <= MOST_TILT:
        centre = (low + high) / 2
        place = A @ centre + t - _about_y(yaw) @ (lengths * centre)
        return Posed(_fields(place, yaw, lengths), None, f"a tilt of {math.degrees(tilt):.1f}°")
    return _baked(A, t, low, high)


def _baked(A: Matrix, t: Matrix, low: Matrix, high: Matrix) -> Posed:
    """The matrix without its yaw in the vertices; the front is that axis which lies level."""
    axes = [A[:, 2], -A[:, 1], A[:, 0]]
    front = max(axes, key=lambda a: math.hypot(a[0], a[2]) / max(float(np.linalg.norm(a)), 1e-12))
    if math.hypot(A[0, 2], A[2, 2]) > 0.5 * float(np.linalg.norm(A[:, 2])):
        front = A[:, 2]
    yaw = math.atan2(front[0], front[2])
    bake = np.eye(4)
    bake[:3, :3] = _about_y(-yaw) @ A
    centre = bake[:3, :3] @ ((low + high) / 2)
    bake[:3, 3] = -centre  # near its own origin, where single precision is finest
    place = t + _about_y(yaw) @ centre
    mirrored = " mirrored" if np.linalg.det(A) < 0 else ""
    note = f"it was{mirrored} about other axes, which went into a new mesh"
    return Posed(_fields(place, yaw, np.ones(3)), bake, note)


def about_y(angle: float) -> Matrix:
    """The right-handed rotation about +y."""
    return _about_y(angle)


def _about_y(angle: float) -> Matrix:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


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
