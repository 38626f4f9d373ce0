"""Scenes of any program: a glTF scene, or boxes only.

Each node with a mesh below it is an object, placed by its node. A camera of the file is the camera
of the capture, where the user gives none. Without one the scene's origin is the camera, which looks
along -z: glTF's axes are ours. Scenes of other tools that were written with y down or z up are
turned by --up.

Boxes (JSON; schema: docs/data.md, "Boxes") are what a 3D detector or a person with a ruler gives:
class, centre, full size, and yaw or a rotation. Each gets the object of the furniture library that
is most like it.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta, Struct

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.furniture.library import choose_piece, plain_name, unknown_names
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts
from mover.io.files.cameras import camera_of_tree, in_pixels_of
from mover.io.files.fields import At, read_json, reason
from mover.io.files.images import image_size
from mover.io.files.meshes import gltf_tree, load_parts, looks_lost
from mover.io.files.schema import (
    Box,
    Id,
    Number,
    Rows,
    Share,
    Sizes,
    Text,
    Vector,
    checked,
    rotation,
)
from mover.io.masks.instances import Instance, Instances
from mover.io.people.values import natural
from mover.io.scenes.placing import FLIP, LEVEL, Matrix, Pieces, about_y, category_of_name, free_id

UP: dict[str, Matrix] = {
    "y": np.eye(3),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""The user's world -> +y up, right-handed."""
OURS = ("ground", "camera", "light")  # what a scene.glb of this program has beside its furniture
SHELL = frozenset({"floor", "wall", "ceiling", "ground", "roof", "window", "door"})
WIDEST = 3.0  # [m], no furniture is wider and deeper
NO_ROOM = 1e-5  # [share], a transform that is nothing but rounding


def glb_parts(path: Path, hints: Hints) -> Parts:
    """The objects of a .glb or .gltf.

    Raises:
        InputError: If it cannot be read or has no objects.
    """
    if not path.is_file() or path.suffix.lower() not in (".glb", ".gltf"):
        raise InputError(f"{path}: is no .glb or .gltf file, expected a glTF scene")
    scene = load_parts(At(path.name, path.parent.name), path)
    turn = affine(up_axes(hints.up))
    camera = hints.camera
    if camera is None and (view := _view(path, hints)) is not None:
        fields, pose = view
        turn[:3, 3] = -turn[:3, :3] @ pose[:3, 3]
        R = FLIP @ pose[:3, :3].T @ turn[:3, :3].T
        camera = At({**fields, "R_cam_world": R.tolist()}, path.name, "cameras")
    found, shell = Pieces(), list[str]()
    for node in _nodes(scene):
        category = hints.names.get(node) or category_of_name(node)
        known = plain_name(category) not in SHELL and not unknown_names([category])
        of_room = not known and not SHELL.isdisjoint(map(plain_name, category.split()))
        if of_room and node not in hints.names:  # `Wall back`, but no `floor lamp`
            shell.append(node)
            continue
        matrix = turn @ np.asarray(scene.graph[node][0])
        found.add_parts(category, node, _below(scene, node), matrix, hints.work)
    if shell:
        said = f"{', '.join(shell)} left out, as parts of the room"
        found.notes.append(f"{path.name}: {said} (--names {shell[0]}=table keeps it)")
    if not found.rows:
        has = f"only {', '.join(shell)}" if shell else "no meshes"
        raise InputError(f"{path.name}: has {has}, expected a node for each object of furniture")
    _check_apart(found, path)
    parts = found.parts(path.stem, path.name, _ground(scene, turn))
    lost = looks_lost(path)
    return dataclasses.replace(parts, camera=camera, notes=(*parts.notes, *[lost] * bool(lost)))


def _check_apart(found: Pieces, path: Path) -> None:
    """Refuse a room whose objects were joined: its only object is wider and deeper than any."""
    row, (mesh, _) = found.rows[0], next(iter(found.meshes.values()))
    size = np.ptp(mesh.verts.numpy(), axis=0) * row["scale"]
    if len(found.rows) == 1 and min(size[0], size[2]) > WIDEST:
        raise InputError(
            f"{path.name}: {row['id']} is one mesh of {size[0]:.1f} x {size[2]:.1f} m, as of a "
            "whole room, expected a node for each object: export it before its objects are joined"
        )


def up_axes(up: str) -> Matrix:
    """The rotation of the user's world into ours.

    Raises:
        InputError: If the axis is none of those known.
    """
    if (up or "y") not in UP:
        raise InputError(f"--up: {up!r} is none of {', '.join(UP)}")
    return UP[up or "y"]


def _nodes(scene: Any) -> list[str]:  # noqa: ANN401
    """The nodes that are objects: the highest ones that are not mere groups, in order.

    A group has no mesh, and several nodes below it have places of their own.
    """
    tree, leaves = scene.graph.transforms, {*scene.graph.nodes_geometry}

    def walk(node: str) -> Iterator[str]:
        if node.startswith("body_") or node.rstrip("_") in OURS:
            return
        below = [child for child in tree.children.get(node, []) if leaves & tree.successors(child)]
        places = [np.asarray(tree.edge_data[node, c].get("matrix", np.eye(4))) for c in below]
        moved = sum(bool(np.abs(place - np.eye(4)).max() > NO_ROOM) for place in places)
        if node == scene.graph.base_frame or (moved > 1 and scene.graph[node][1] is None):
            for child in below:
                yield from walk(child)
        else:
            yield node

    return sorted(walk(scene.graph.base_frame), key=lambda node: natural(Path(node)))


def _below(scene: Any, node: str) -> Any:  # noqa: ANN401
    """The meshes at and below a node, in its own axes."""
    import trimesh

    out = trimesh.Scene()
    back = np.linalg.pinv(np.asarray(scene.graph[node][0]))
    for leaf in sorted(scene.graph.transforms.successors(node) & {*scene.graph.nodes_geometry}):
        matrix, geometry = scene.graph[leaf]
        transform = np.eye(4) if leaf == node else back @ np.asarray(matrix)
        out.add_geometry(scene.geometry[geometry], node_name=leaf, transform=transform)
    return out


def _ground(scene: Any, turn: Matrix) -> float | None:  # noqa: ANN401
    """Height of a node that is called ground, None where there is none."""
    for node in scene.graph.nodes_geometry:
        if node.rstrip("_") == "ground":
            matrix, geometry = scene.graph[node]
            verts = np.asarray(scene.geometry[geometry].vertices)
            world = verts @ (turn @ matrix)[:3, :3].T + (turn @ matrix)[:3, 3]
            return float(np.median(world[:, 1]))
    return None


def _view(path: Path, hints: Hints) -> tuple[dict[str, Any], Matrix] | None:
    """Fields and pose of the file's first camera; 1080 pixels high without an image."""
    try:
        tree: Any = gltf_tree(path)
        nodes = tree.get("nodes", [])
        index = next((i for i, node in enumerate(nodes) if "camera" in node), None)
        if index is None:
            return None
        lens = tree["cameras"][nodes[index]["camera"]]["perspective"]
        at = At(lens, path.name, "cameras.perspective").maybe("aspectRatio")
        ratio = None if at is None else float(at.value)
        w, h = (0, 1080) if hints.image is None else image_size(hints.image)
        w = w or round(h * (ratio or 16 / 9))
        tangent = math.tan(float(lens["yfov"]) / 2)
        fy = h / 2 / tangent
        fx = fy if ratio is None else w / 2 / (tangent * ratio)
        fields = {"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": w / 2, "cy": h / 2}
        return fields, _pose_of(nodes, index)
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        found = f"a camera that cannot be read ({reason(error)})"
        raise InputError(f"{path.name}: has {found}, expected a perspective camera") from error


def _pose_of(nodes: Any, index: int) -> Matrix:  # noqa: ANN401
    """World from a node, without scale: matrices by columns, or translation, rotation and scale."""
    from scipy.spatial.transform import Rotation

    parent = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
    pose, seen = np.eye(4), set[int]()
    at: int | None = index
    while at is not None and at not in seen:
        seen.add(at)
        node = nodes[at]
        if "matrix" in node:
            own = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
        else:
            turn = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
            place = np.array(node.get("translation", [0.0, 0.0, 0.0]), dtype=np.float64)
            own = affine(turn @ np.diag(node.get("scale", [1.0, 1.0, 1.0])), place)
        pose = own @ pose
        at = parent.get(at)
    u, _, v = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = u @ v
    return pose


class BoxFields(Struct, frozen=True):
    """One box."""

    category: Text
    size: Sizes
    center: Vector
    yaw: Annotated[float, Meta(ge=-10, le=10)] | None = None
    rotation: Rows | None = None
    id: Any = None
    box2d: Box | None = None
    score: Share | None = None
    support: Text | None = None


class BoxesFields(Struct, frozen=True):
    """The whole file."""

    objects: list[BoxFields]
    camera: Any = None
    frame: Literal["world", "camera"] | None = None
    up: Literal["y", "-y", "z"] | None = None
    ground: Number | None = None


def box_parts(path: Path, hints: Hints) -> Parts:
    """Furniture in boxes: the whole file, or the list of its objects alone."""
    at = read_json(path)
    at = at.holding({"objects": at.value}) if isinstance(at.value, list) else at
    tree = checked(at, BoxesFields)
    camera = hints.camera
    if camera is None and tree.camera is not None:
        size = None if hints.image is None else image_size(hints.image)
        camera = in_pixels_of(size, camera_of_tree(At(tree.camera, at.file, "camera"), size))
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
