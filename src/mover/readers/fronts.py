"""Where the front of a mesh is that has no axes of its own."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..furniture.library import BACKS, BEDS, canonical
from ..types import Mesh
from .fields import At
from .mesh_file import read_mesh
from .placing import Matrix, about_y, load_parts, write_parts

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


def without_axes(
    path: Path, world: Matrix, category: str, file: Path
) -> tuple[dict[str, Any], tuple[Mesh, str]]:
    """The place of a mesh that lies where it is, and a copy about the middle of its box's bottom.

    Args:
        path: The mesh.
        world: Our world (+y up, the camera at the origin) from its vertices (4, 4).
        category: Free text.
        file: Where the copy goes.

    Raises:
        InputError: If the mesh cannot be read.
    """
    mesh, _ = read_mesh(At(path.name, path.name), path.parent)
    verts = mesh.verts.double().numpy() @ world[:3, :3].T + world[:3, 3]
    yaw = guess_front(verts, category)
    local = verts @ about_y(yaw)  # rows: R_y(-yaw) v
    low, high = local.min(0), local.max(0)
    origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    bake = np.eye(4)
    bake[:3, :3], bake[:3, 3] = about_y(-yaw), -origin
    found = write_parts(load_parts(path), bake @ world, file)
    place = about_y(yaw) @ origin
    return {"translation": place.tolist(), "yaw": yaw, "scale": [1.0, 1.0, 1.0]}, found
