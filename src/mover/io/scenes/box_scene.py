"""Boxes only (JSON): each gets the object of the furniture library that is most like it.

Schema: docs/data.md, "Boxes". A box is what a 3D detector or a person with a ruler gives: class,
centre, full size, and yaw or a rotation.
"""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from mover.core.types import Mesh
from mover.furniture.library import choose_piece
from mover.io.capture.parts import Hints, Parts
from mover.io.files import schema
from mover.io.files.cameras import camera_of_tree
from mover.io.files.fields import At, read_json
from mover.io.files.images import image_size
from mover.io.files.schema import Id, Text, checked, rotation
from mover.io.masks.instances import Instance, Instances
from mover.io.scenes.glb_scene import up_axes
from mover.io.scenes.placing import LEVEL, Matrix, Pieces, about_y, free_id


class BoxFields(Struct, frozen=True):
    """One box."""

    category: Text
    size: schema.Sizes
    center: schema.Vector
    yaw: Annotated[float, Meta(ge=-10, le=10)] | None = None
    rotation: schema.Rows | None = None
    id: Any = None
    box2d: schema.Box | None = None
    score: schema.Share | None = None
    support: Text | None = None


class BoxesFields(Struct, frozen=True):
    """The whole file."""

    objects: list[BoxFields]
    camera: Any = None
    frame: Literal["world", "camera"] | None = None
    up: Literal["y", "-y", "z"] | None = None
    ground: schema.Number | None = None


def box_parts(path: Path, hints: Hints) -> Parts:
    """Furniture in boxes."""
    at = read_json(path)
    tree = checked(at, BoxesFields)
    camera = hints.camera
    if camera is None and tree.camera is not None:
        size = None if hints.image is None else image_size(hints.image)
        camera = camera_of_tree(At(tree.camera, at.file, "camera"), size)
    turn = up_axes(hints.up or tree.up or "y")
    if tree.frame == "camera":
        tilt = None if camera is None else camera.maybe("R_cam_world")
        turn = (np.array(LEVEL) if tilt is None else rotation(tilt)).T
    found = Pieces()
    for i, (item, box) in enumerate(zip(at.get("objects").items(), tree.objects, strict=True)):
        kind = Id if isinstance(box.id, int) else Text
        name = "" if box.id is None else str(checked(item.get("id"), kind))
        fields, mesh = _placed(item, box, turn, i)
        category = str(box.category)
        found.add(category, free_id(category, name, found.meshes), fields, mesh, "")
    return dataclasses.replace(
        found.parts(path.stem, path.name, tree.ground),
        camera=camera,
        objects=_annotations(tree.objects, camera, at.file),
    )


def _placed(at: At, box: BoxFields, turn: Matrix, index: int) -> tuple[dict[str, Any], Mesh]:
    """The fields of a box's object in scene.json, and the mesh of the library that fills it."""
    if box.rotation is not None:
        axes = turn @ rotation(at.get("rotation"))  # columns
    elif box.yaw is not None:
        axes = about_y(box.yaw)  # about the vertical, from the front at +z
    else:
        at.get("yaw").refuse("an angle, or a 'rotation'")
    order, yaw = _upright(at, axes)
    size = np.array(box.size)[order]
    mesh = choose_piece(str(box.category), (float(size[0]), float(size[1]), float(size[2])))
    low, high = mesh.verts.double().numpy().min(0), mesh.verts.double().numpy().max(0)
    centre = turn @ np.array(box.center)
    place = centre - np.array([0.0, size[1] / 2, 0.0])  # the library stands on its bottom
    return {
        "annotation": None if box.box2d is None else index, "translation": place.tolist(),
        "yaw": yaw, "scale": (size / (high - low)).tolist(),
        "support": "ground" if box.support is None else str(box.support),
    }, mesh  # fmt: skip


def _upright(at: At, axes: Matrix) -> tuple[Sequence[int], float]:
    """Which axes are width, height and depth, and the yaw of the front, in our world.

    The axis nearest to the vertical is the height, even if the file's y is another. The front is
    the box's own z where that is level, else the axis that leads to it by turning the box upright.
    """
    up = int(np.abs(axes[1]).argmax())
    order = ([1, 0, 2], [0, 1, 2], [0, 2, 1])[up]  # z-up boxes: x stays, their -y is the front
    front = axes[:, order[2]] * (-1.0 if up == 2 and axes[1, 2] > 0 else 1.0)
    if math.hypot(front[0], front[2]) < 0.1:
        at.get("rotation").refuse("a box with an axis that is nearly level")
    return order, math.atan2(front[0], front[2])


def _annotations(boxes: Sequence[BoxFields], camera: At | None, file: str) -> At | None:
    """What objects.json says of boxes that have a rectangle in the image."""
    if camera is None or all(box.box2d is None for box in boxes):
        return None
    found = tuple(
        Instance(str(box.category), box.box2d, None, 1.0 if box.score is None else box.score)
        for box in boxes
    )
    size = camera.get("w").integer(1), camera.get("h").integer(1)
    return Instances(found, size, file).objects_tree()
