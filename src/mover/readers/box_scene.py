"""Boxes only (JSON): each gets the piece of the furniture library that is most like it.

Schema: docs/data.md, "Boxes". A box is what a 3D detector or a person with a ruler gives: class,
centre, full size, and yaw or a rotation.
"""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..furniture.choose import choose_piece
from ..types import Mesh
from .any_camera import camera_of_tree
from .fields import (
    LAST_ID,
    At,
    choice,
    get,
    integer,
    items,
    maybe,
    number,
    positive,
    read_json,
    refuse,
    rotation,
    text,
    vector,
)
from .glb_scene import UP, up_axes
from .image_file import image_size
from .instances import Instance, Instances, objects_tree
from .parts import Hints, Parts
from .placing import LEVEL, Matrix, about_y, load_from
from .scene_file import FORMAT, VERSION
from .words import free_id

FRAMES = ("world", "camera")


def box_parts(path: Path, hints: Hints) -> Parts:
    """Furniture in boxes.

    Raises:
        InputError: If a field is wrong.
    """
    at = read_json(path)
    given = maybe(at, "camera")
    camera = hints.camera
    if camera is None and given is not None:
        size = None if hints.image is None else image_size(hints.image)
        camera = camera_of_tree(At(given.value, at.file, "camera"), size)
    turn = _world(at, camera, hints.up)
    rows: list[dict[str, Any]] = []
    meshes: dict[str, tuple[Mesh, str]] = {}
    boxes = items(get(at, "objects"))
    for item in boxes:
        row, mesh = _piece(item, turn, meshes)
        meshes[row["id"]] = mesh, ""
        rows.append(row)
    tree: dict[str, Any] = {"format": FORMAT, "version": VERSION, "objects": rows}
    ground = maybe(at, "ground")
    if ground is not None:
        tree["ground"] = {"height": number(ground)}
    return Parts(
        name=path.stem,
        camera=camera,
        scene=At(tree, path.name),
        objects=_annotations(boxes, rows, camera, at.file),
        load_mesh=partial(load_from, meshes),
    )


def _world(at: At, camera: At | None, up: str) -> Matrix:
    """Our world from the file's: its `up` in a world, or the camera's axes."""
    known = maybe(at, "frame")
    if known is None or choice(known, FRAMES) == "world":
        own = maybe(at, "up")
        return up_axes(up or ("y" if own is None else choice(own, tuple(UP))))
    tilt = None if camera is None else maybe(camera, "R_cam_world")
    return (np.array(LEVEL) if tilt is None else rotation(tilt)).T


def _piece(at: At, turn: Matrix, used: dict[str, tuple[Mesh, str]]) -> tuple[dict[str, Any], Mesh]:
    """The fields of an object, and the mesh of the library that fills its box."""
    category = text(get(at, "category"))
    size = np.array([positive(v) for v in items(get(at, "size"), 3)])
    centre = turn @ np.array(vector(get(at, "center"), 3))
    order, yaw = _upright(at, _axes(at, turn))
    size = size[order]
    mesh = choose_piece(category, (float(size[0]), float(size[1]), float(size[2])))
    low, high = mesh.verts.double().numpy().min(0), mesh.verts.double().numpy().max(0)
    place = centre - np.array([0.0, size[1] / 2, 0.0])  # the library stands on its bottom
    own = maybe(at, "id")
    name = free_id(category, "" if own is None else _word(own), used)
    support = maybe(at, "support")
    return {
        "id": name,
        "category": category,
        "mesh": name,
        "annotation": None if maybe(at, "box2d") is None else len(used),
        "translation": place.tolist(),
        "yaw": yaw,
        "scale": (size / (high - low)).tolist(),
        "support": "ground" if support is None else text(support),
    }, mesh


def _word(at: At) -> str:
    return str(integer(at, 0, LAST_ID)) if isinstance(at.value, int) else text(at)


def _axes(at: At, turn: Matrix) -> Matrix:
    """The box's axes as columns in our world; a yaw is about the vertical, from the front at +z."""
    matrix = maybe(at, "rotation")
    return about_y(number(get(at, "yaw"), -10, 10)) if matrix is None else turn @ rotation(matrix)


def _upright(at: At, axes: Matrix) -> tuple[Sequence[int], float]:
    """Which axes are width, height and depth, and the yaw of the front, in our world.

    The axis nearest to the vertical is the height, even if the file's y is another. The front is
    the box's own z where that is level, else the axis that leads to it by turning the box upright.
    """
    up = int(np.abs(axes[1]).argmax())
    if up == 1:
        order = [0, 1, 2]
    elif up == 2:
        order = [0, 2, 1]  # z-up boxes: x stays, their -y is the front
    else:
        order = [1, 0, 2]
    front = axes[:, order[2]] * (-1.0 if up == 2 and axes[1, 2] > 0 else 1.0)
    if math.hypot(front[0], front[2]) < 0.1:
        refuse(get(at, "rotation"), "a box with an axis that is nearly level")
    return order, math.atan2(front[0], front[2])


def _annotations(
    boxes: Sequence[At], rows: Sequence[dict[str, Any]], camera: At | None, file: str
) -> At | None:
    """What objects.json says of boxes that tell their rectangle in the image."""
    found: list[Instance] = []
    for item, row in zip(boxes, rows, strict=True):
        flat, score = maybe(item, "box2d"), maybe(item, "score")
        corners = None if flat is None else tuple(vector(flat, 4))
        sure = 1.0 if score is None else number(score, 0, 1)
        found.append(Instance(row["category"], corners, None, sure))
    if camera is None or all(item.box is None for item in found):
        return None
    size = integer(get(camera, "w"), 1), integer(get(camera, "h"), 1)
    return objects_tree(Instances(tuple(found), size, file), found)
