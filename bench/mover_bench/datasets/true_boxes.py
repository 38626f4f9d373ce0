"""True boxes of data sets, and what a scan has inside them: scenes for `mover evaluate`."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Mesh, Scene
from mover.geometry.mesh import used
from mover.io.capture.camera_file import camera_of
from mover.io.capture.scene_file import scene_of, scene_tree
from mover.io.files.fields import At, read_json
from mover.io.files.meshes import read_mesh
from mover.io.scenes.placing import Matrix, category_of_name, free_id, load_from

SIGNS = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=float)
FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip
"""Triangles of a box whose corners are in the order of `SIGNS`, seen from outside."""
MARGIN = 0.02  # [m], a scan's surface lies so far outside of its box
LEAST = 12  # triangles, fewer are no object
FLOOR = 0.03  # [m], a scan's floor lies so near to its height


@dataclass(frozen=True)
class TrueBox:
    """An upright box of a data set in the frame of its file."""

    name: str
    category: str
    center: Matrix
    half: Matrix
    axes: Matrix  #: its axes as rows, in the order of `half`


def read_bbox3d(path: Path, names: Mapping[str, str]) -> list[TrueBox]:
    """The boxes of MOVER's authors: {id: {centroid, basis, coeffs}}, with half sizes.

    The page does not say whether the axes are the rows or the columns of `basis`: the reading in
    which the boxes agree better on what is up counts. `names` are categories by id.
    """
    file = read_json(path)
    rows = {key: file.get(key) for key in file.mapping()}
    if not rows:
        raise InputError(f"{path.name}: has no boxes, expected {{id: {{centroid, basis, coeffs}}}}")
    bases = {key: _basis(row.get("basis")) for key, row in rows.items()}
    turned = _agree([b.T for b in bases.values()]) > _agree(list(bases.values())) + 1e-6
    return [
        TrueBox(
            name=key,
            category=names.get(key) or category_of_name(key),
            center=np.array(_flat(row.get("centroid"))),
            half=np.abs(np.array(_flat(row.get("coeffs")))),
            axes=bases[key].T if turned else bases[key],
        )
        for key, row in rows.items()
    ]


def _flat(at: At) -> list[float]:
    """Three numbers, maybe in a list of one list."""
    inner = at.value[0] if isinstance(at.value, list) and len(at.value) == 1 else at.value
    return at.holding(inner).vector(3)


def _basis(at: At) -> Matrix:
    """Three axes of length 1."""
    if not isinstance(at.value, list) or len(at.value) != 3:
        at.refuse("three axes of three numbers")
    rows = np.array([At(r, at.file, f"{at.field}[{i}]").vector(3) for i, r in enumerate(at.value)])
    if np.abs(rows @ rows.T - np.eye(3)).max() > 1e-2:
        at.refuse("three axes at right angles, of length 1")
    return rows


def _agree(bases: Sequence[Matrix]) -> float:
    """How well upright boxes agree on the vertical: the best axis of the first, over all others."""
    scores = [
        sum(float(np.abs(other @ axis).max()) for other in bases) for axis in bases[0]
    ]  # the axis of each that is nearest to this one
    return max(scores) / len(bases)


def vertical_of(boxes: Sequence[TrueBox], guess: Matrix) -> Matrix:
    """The direction that the boxes share and that is nearest to a guess of what is up."""
    found: list[Matrix] = []
    for box in boxes:
        along = box.axes @ guess
        best = int(np.abs(along).argmax())
        found.append(box.axes[best] * np.sign(along[best]))
    mean = np.sum(found, axis=0)
    return mean / np.linalg.norm(mean)


def boxes_scene(
    boxes: Sequence[TrueBox],
    world: Matrix,
    camera: Mapping[str, Any],
    ground: float | None,
    scan: Mesh | None = None,
) -> Scene:
    """A scene of the boxes, or of what a scan (in their frame) has inside them.

    `world` is our world (+y up, the camera at the origin) from the frame of the boxes (4, 4),
    `ground` the height of the floor in it [m]: triangles of a scan that lie there are left out.
    """
    if scan is not None and ground is not None:
        low = torch.from_numpy(np.abs(_heights(scan, world) - ground) < FLOOR)
        scan = dataclasses.replace(scan, faces=scan.faces[~low[scan.faces].all(1)])
    rows: list[dict[str, Any]] = []
    meshes: dict[str, tuple[Mesh, str]] = {}
    for box in boxes:
        order, signs, yaw = _upright(box.axes @ world[:3, :3].T)
        own = Mesh(torch.from_numpy(SIGNS * box.half[order]).float(), torch.from_numpy(FACES))
        mesh = own if scan is None else _inside(scan, box, order, signs)
        if mesh is None:
            continue
        name = free_id(box.category, box.name, meshes)
        meshes[name] = mesh, ""
        place = world[:3, :3] @ box.center + world[:3, 3]
        row = {"id": name, "category": box.category, "mesh": name, "scale": [1.0, 1.0, 1.0]}
        rows.append({**row, "translation": place.tolist(), "yaw": yaw, "support": "free"})
    lens = camera_of(At(dict(camera), "camera"))
    tree, load = scene_tree(rows, "truth", ground), partial(load_from, meshes)
    return scene_of(tree, load, lens, lambda _: None)[0]


def _heights(scan: Mesh, world: Matrix) -> NDArray[np.float64]:
    """Of a scan's vertices in our world, of which `world` is the matrix from its frame [m]."""
    return scan.verts.double().numpy() @ world[1, :3] + world[1, 3]


def _upright(axes: Matrix) -> tuple[list[int], Matrix, float]:
    """Width, height and depth among the rows, the signs that make them right-handed, the yaw."""
    up = int(np.abs(axes[:, 1]).argmax())
    right, front = [i for i in range(3) if i != up]
    order = [right, up, front]
    signs = np.array([1.0, math.copysign(1.0, axes[up, 1]), 1.0])
    signs[0] = math.copysign(1.0, float(np.linalg.det(axes[order] * signs[:, None])))
    return order, signs, math.atan2(axes[front, 0], axes[front, 2])


def _inside(scan: Mesh, box: TrueBox, order: Sequence[int], signs: Matrix) -> Mesh | None:
    """The triangles of a scan inside a box, in the box's own axes; None where there are few."""
    axes = box.axes[list(order)] * signs[:, None]
    local: Matrix = (scan.verts.double().numpy() - box.center) @ axes.T
    within: NDArray[np.bool_] = np.all(np.abs(local) <= box.half[list(order)] + MARGIN, axis=1)
    faces = scan.faces.numpy()
    faces = faces[within[faces].all(1)]
    if len(faces) < LEAST:
        return None
    return used(Mesh(torch.from_numpy(local).float(), torch.from_numpy(faces)))


BIN = 0.02  # [m], of the histogram of heights
REACH = 0.6  # [m], the floor is so near to the lowest points
SHARE = 0.25  # of the fullest bin there: less is noise below the floor
OUTLIERS = 0.002  # share of the lowest points that may be anything


def read_scan(path: Path) -> Mesh:
    """A scan in the frame of its file."""
    return read_mesh(At(path.name, path.name), path.parent)[0]


def floor_in(scan: Mesh, world: Matrix) -> float:
    """Height of a scan's lowest large level part in our world, as `_heights` has it [m]."""
    heights = _heights(scan, world)
    lowest = float(np.quantile(heights, OUTLIERS))
    near = heights[(heights >= lowest - BIN) & (heights <= lowest + REACH)]
    edges = np.arange(lowest - BIN, lowest + REACH + BIN, BIN)
    counts, _ = np.histogram(near, edges)
    full = int(np.flatnonzero(counts >= SHARE * counts.max())[0])
    best = full + int(counts[full : full + 3].argmax())
    close = near[np.abs(near - (edges[best] + BIN / 2)) <= BIN]
    return float(np.median(close)) if len(close) else float(edges[best] + BIN / 2)
