"""Numbers and meshes as text for the formats of simulators."""

from collections.abc import Iterable

import numpy as np

from ..types import Mesh


def numbers(values: Iterable[float]) -> str:
    """Decimals with a space between them."""
    return " ".join(f"{value:.8g}" for value in values)


def obj_bytes(mesh: Mesh) -> bytes:
    """A mesh as Wavefront OBJ: places and triangles."""
    lines = [f"v {numbers(place)}" for place in mesh.verts.tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in face) for face in mesh.faces.tolist()]
    return ("\n".join(lines) + "\n").encode()


def stl_bytes(mesh: Mesh) -> bytes:
    """A mesh as binary STL."""
    corners = mesh.verts.numpy()[mesh.faces.numpy()].astype(np.float32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1)
    kind = np.dtype([("numbers", "<f4", 12), ("attribute", "<u2")])
    triangles = np.zeros(len(corners), kind)
    triangles["numbers"] = np.concatenate([normals, corners.reshape(-1, 9)], 1)
    return bytes(80) + np.uint32(len(corners)).tobytes() + triangles.tobytes()
