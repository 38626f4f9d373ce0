"""scene.json: the initial scene, the result and the truth."""

import json
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from msgspec import Meta, Struct
from torch import Tensor

from mover.core.types import Camera, Scene, SceneObject, Segment
from mover.geometry.rotations import rot_y, wrap
from mover.io.capture.camera_file import camera_of, camera_to_json, check_attitude, turned
from mover.io.capture.parts import LoadMesh
from mover.io.files.fields import At, Warn, listed, plain, read_json, unique, write_json
from mover.io.files.meshes import copy_mesh, read_mesh, stretch_file, write_mesh
from mover.io.files.schema import Id, Index, Number, Share, Sizes, Text, Vector, checked

log = logging.getLogger(__name__)

FORMAT, VERSION = "mover-scene", 1
SAFE_ID = re.compile(r"\w[\w.-]*")
LONGEST_ID = 60  # [bytes]
WORDS = ("ground", "free")
LOWEST = 30.0  # [m], of a floor below the camera
Placed = SceneObject | Segment


def read_scene(path: Path, camera: Camera | None = None) -> Scene:
    """Read and check a scene and its meshes; `camera` is used where the file has none."""
    load = partial(read_mesh, folder=path.parent)
    return scene_of(read_json(path), load, camera, log.warning)[0]


class PlaceFields(Struct, frozen=True):
    """A mesh, and where it stands."""

    mesh: Text
    translation: Vector
    yaw: Number
    scale: Sizes

    def tensors(self) -> dict[str, Any]:
        """Translation, yaw and scale, by their names in `SceneObject`."""
        found = {"t_world_object": self.translation, "yaw": self.yaw, "scale": self.scale}
        return {name: torch.tensor(value) for name, value in found.items()}


class SegmentFields(Struct, frozen=True):
    """Where an object stands from a frame on."""

    frame: Index
    translation: Vector
    yaw: Number
    mover: Index | None = None


class ObjectFields(PlaceFields, frozen=True, kw_only=True):
    """One of `objects`."""

    id: Text
    category: Text
    annotation: Id | None = None
    support: Text | None = None
    segments: list[SegmentFields] | None = None


class Ground(Struct, frozen=True):
    """`ground`."""

    height: Annotated[float, Meta(ge=-LOWEST, le=LOWEST)]


class SceneFields(Struct, frozen=True):
    """scene.json."""

    format: Literal["mover-scene"]
    version: Literal[1]
    objects: list[ObjectFields]
    camera: Any = None
    ground: Ground | None = None
    size_spread: Share = 0.0


def scene_of(at: At, load: LoadMesh, camera: Camera | None, warn: Warn) -> tuple[Scene, float]:
    """The scene of a JSON object, in the world where the camera has no heading.

    Returns:
        The scene and the angle by which the world was turned about +y [rad].
    """
    if at.maybe("format") is None and at.maybe("annotations") is not None:
        at.refuse("a scene with 'format' and 'objects'", "COCO's annotations (is it objects.json?)")
    fields = checked(at, SceneFields)
    if fields.camera is not None:
        camera = camera_of(at.get("camera"), camera)
    if camera is None:
        at.get("camera").refuse("a camera, here or in camera.json")
    ground = None if fields.ground is None else fields.ground.height
    if ground is not None and ground >= 0:
        warn(f"{at.file}: the ground is not below the camera (height {ground:g} m)")
    objects = _objects_of(at.get("objects"), fields.objects, load)
    camera, angle = turned(camera)
    check_attitude(camera, at.file, warn)
    objects = tuple(_turn(one, angle) for one in objects) if angle else tuple(objects)
    return Scene(camera, ground, objects, fields.size_spread), angle


def _objects_of(at: At, rows: Sequence[ObjectFields], load: LoadMesh) -> list[SceneObject]:
    """All objects of a scene, with their relations checked."""
    ids, annotations = set[object](), set[object]()
    objects: list[SceneObject] = []
    for item, row in zip(at.items(), rows, strict=True):
        check_id(item.get("id"))
        unique(item.get("id"), ids, row.id.casefold(), "an id (in any case)")
        if row.annotation is not None:
            unique(item.get("annotation"), annotations, row.annotation, "an annotation")
        segments = [Segment(one.frame, torch.tensor(one.translation), torch.tensor(one.yaw),
                            one.mover) for one in row.segments or ()]  # fmt: skip
        for k, (before, after) in enumerate(pairwise(one.frame for one in segments), 1):
            if after <= before:
                field = At(after, at.file, f"{item.field}.segments[{k}].frame")
                field.refuse(f"a frame after {before}, in which the segment before begins")
        mesh, file = load(item.get("mesh"))
        support = "ground" if row.support is None else str(row.support)
        objects.append(
            SceneObject(str(row.id), str(row.category), mesh, file, row.annotation, support,
                        **row.tensors(), segments=tuple(segments))
        )  # fmt: skip
    _check_supports(at, objects)
    return objects


def check_id(at: At) -> None:
    """Refuse an id that is not safe as the name of a file, or means something else."""
    name = at.value
    if not SAFE_ID.fullmatch(name) or name.casefold() in WORDS or name.endswith("."):
        at.refuse("letters, digits, '_', '-' or '.', not 'ground' or 'free'")
    if len(name.encode()) > LONGEST_ID:  # with endings, a file's name has 255 bytes at most
        at.refuse(f"at most {LONGEST_ID} bytes", f"{len(name.encode())}")


def _check_supports(at: At, objects: list[SceneObject]) -> None:
    """Each object stands on the ground, is free, or stands on others without a circle."""
    under = {one.id: one.support for one in objects}
    for i, one in enumerate(objects):
        field = At(one.support, at.file, f"{at.field}[{i}].support")
        below, visited = one.support, {one.id}
        while below not in WORDS:
            if below not in under:
                field.refuse("'ground', 'free' or the id of an object", f"{below!r}")
            if below in visited:
                field.refuse("supports that end at the ground", "a circle of supports")
            visited.add(below)
            below = under[below]


def _turn(one: SceneObject, angle: float) -> SceneObject:
    """The object in the world turned about +y [rad]."""
    turn = torch.tensor(angle, dtype=torch.float64)

    def turned_by(place: Placed) -> dict[str, Tensor]:
        t = (rot_y(turn) @ place.t_world_object.double()).to(place.t_world_object)
        return {"t_world_object": t, "yaw": wrap(place.yaw.double() + turn).to(place.yaw)}

    return everywhere(one, turned_by)


def everywhere(one: SceneObject, change: Callable[[Placed], dict[str, Tensor]]) -> SceneObject:
    """The object with new fields, and so each of its segments."""
    segments = tuple(replace(part, **change(part)) for part in one.segments)
    return replace(one, **change(one), segments=segments)


def scene_tree(objects: Sequence[Mapping[str, Any]], file: str, ground: float | None = None) -> At:
    """scene.json of the fields of objects that a reader found; `ground` is its height [m]."""
    below = {} if ground is None else {"ground": {"height": ground}}
    return At({"format": FORMAT, "version": VERSION, **below, "objects": list(objects)}, file)


def write_scene(
    scene: Scene, path: Path, more: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write a scene: the user's meshes are copied as they are, new ones become meshes/<id>.glb.

    The copy of a mesh whose seat was raised, meshes/<id>+seat.glb beside that of the initial scene,
    keeps parts, materials and textures (`stretch_file`).

    Args:
        scene: What is written.
        path: The file; `meshes/` goes beside it.
        more: Further fields of the objects, by their ids; `read_scene` does not look at them.
    """
    meshes = path.parent / "meshes"
    objects: list[dict[str, Any]] = []
    for piece in scene.objects:
        source = Path(piece.mesh_file)
        name = piece.id if piece.stretch is None else f"{piece.id}+seat"
        if source.is_absolute() and source.is_file():
            target = copy_mesh(source, meshes, name)
            if piece.stretch is not None:
                target = stretch_file(target, piece.stretch)
        else:
            target = meshes / f"{name}.glb"
            write_mesh(piece.mesh, target)
        mesh = target.relative_to(path.parent).as_posix()
        annotation = {} if piece.annotation is None else {"annotation": piece.annotation}
        row = {"id": piece.id, "category": piece.category, "mesh": mesh, **annotation,
               **_placed(piece), "scale": plain(piece.scale), "support": piece.support}  # fmt: skip
        if piece.segments:
            row["segments"] = [{"frame": s.frame, **_placed(s)}
                               | ({} if s.mover is None else {"mover": s.mover})
                               for s in piece.segments]  # fmt: skip
        objects.append({**row, **(more or {}).get(piece.id, {})})
    spread = {"size_spread": scene.size_spread} if scene.size_spread else {}
    below = {} if scene.ground is None else {"ground": {"height": scene.ground}}
    head = {"format": FORMAT, "version": VERSION, "camera": camera_to_json(scene.camera)}
    write_json({**head, **spread, **below, "objects": objects}, path)


def _placed(one: Placed) -> dict[str, Any]:
    return {"translation": plain(one.t_world_object), "yaw": plain(one.yaw)}


# hypotheses.json: other ways in which the objects of a first scene may stand.


HYPOTHESES = "hypotheses.json"
MOST = 16  # of one object
SAME = 0.01  # [m] and [rad]: the first row of an object is its place in the scene
Places = Annotated[
    list[PlaceFields], Meta(max_length=MOST, description=f"at most {MOST} hypotheses")
]


class HypothesesFields(Struct, frozen=True):
    """hypotheses.json."""

    format: Literal["mover-hypotheses"]
    version: Literal[1]
    objects: dict[str, Places]


def hypotheses_of(at: At, load: LoadMesh, scene: Scene, warn: Warn) -> tuple[SceneObject, ...]:
    """Other positions and shapes of the scene's objects, under the ids of those objects.

    The first row of each object is the one that the scene has. Where it is not, the scene came
    from elsewhere or was changed since, and the object's rows are left out with a warning.
    """
    objects, own = at.get("objects"), {one.id: one for one in scene.objects}
    found: list[SceneObject] = []
    stale: list[str] = []
    for name, rows in checked(at, HypothesesFields).objects.items():
        first, home = own.get(name), rows[0].tensors() if rows else None
        near = first is not None and home is not None and max(
            float((home["t_world_object"] - first.t_world_object).norm()),
            float(wrap(home["yaw"] - first.yaw).abs()),
        ) < SAME  # fmt: skip
        if first is None or not near:
            stale.append(name)
            continue
        for row, place in zip(rows[1:], objects.get(name).items()[1:], strict=True):
            mesh, file = load(place.get("mesh"))
            found.append(replace(first, mesh=mesh, mesh_file=file, **row.tensors()))
    if stale:
        warn(f"{at.file}: not of this scene, so not used: {listed('object', stale)}")
    return tuple(found)


def write_hypotheses(folder: Path, groups: Mapping[str, Sequence[SceneObject]]) -> None:
    """Write hypotheses.json beside a scene.json that is written already, and their meshes.

    The groups hold those of each object, best first; the first is the one in the scene. Without
    any group there is no such file.
    """
    if not groups:
        (folder / HYPOTHESES).unlink(missing_ok=True)
        return
    scene = json.loads((folder / "scene.json").read_text())
    meshes = {row["id"]: row["mesh"] for row in scene["objects"]}
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, group in groups.items():
        rows[name] = []
        for rank, one in enumerate(group):
            mesh = f"meshes/other/{name}_{rank}.glb" if rank else meshes[name]
            if rank:
                write_mesh(one.mesh, folder / mesh)
            rows[name].append({"mesh": mesh, **_placed(one), "scale": plain(one.scale)})
    tree = {"format": "mover-hypotheses", "version": VERSION, "objects": rows}
    write_json(tree, folder / HYPOTHESES)
