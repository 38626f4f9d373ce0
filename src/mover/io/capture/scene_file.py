"""scene.json: the initial scene, the result and the truth."""

import dataclasses
import json
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from mover.core.types import Camera, Mesh, Scene, SceneObject, Segment
from mover.geometry.rotations import rot_y, wrap
from mover.io.capture.camera_file import camera_of, camera_to_json, check_attitude, turned
from mover.io.files.fields import (
    At,
    Warn,
    get,
    items,
    listed,
    plain,
    read_json,
    refuse,
    unique,
    write_json,
)
from mover.io.files.meshes import copy_mesh, read_mesh, stretch_file, write_mesh
from mover.io.files.schema import Id, Index, Number, Sizes, Text, Vector, checked

log = logging.getLogger(__name__)

FORMAT, VERSION = "mover-scene", 1
SAFE_ID = re.compile(r"\w[\w.-]{0,99}")
WORDS = ("ground", "free")
LOWEST = 30.0  # [m], of a floor below the camera
P = TypeVar("P", SceneObject, Segment)
LoadMesh = Callable[[At], tuple[Mesh, str]]
"""Gives the mesh that a field names, and its file."""


def read_scene(path: Path, camera: Camera | None = None, warn: Warn = log.warning) -> Scene:
    """Read and check a scene and its meshes.

    Args:
        path: Of scene.json; meshes are relative to its folder.
        camera: Used where the file has none.
        warn: Takes what is odd but not wrong.
    """

    def load(at: At) -> tuple[Mesh, str]:
        return read_mesh(at, path.parent)

    return scene_of(read_json(path), load, camera, warn)[0]


class PlaceFields(Struct, frozen=True):
    """A mesh, and where it stands."""

    mesh: Text
    translation: Vector
    yaw: Number
    scale: Sizes
    energy: Number | None = None


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


Spot = tuple[Number, Number]
"""(x, z) [m]"""


class SceneFields(Struct, frozen=True):
    """scene.json."""

    format: Literal["mover-scene"]
    version: Literal[1]
    objects: list[ObjectFields]
    camera: Any = None
    ground: Ground | None = None
    layout: tuple[Spot, Spot, Spot, Spot] | None = None
    size_spread: Annotated[float, Meta(ge=0, le=1)] = 0.0


def scene_of(at: At, load: LoadMesh, camera: Camera | None, warn: Warn) -> tuple[Scene, float]:
    """The scene of a JSON object, in the world where the camera has no heading.

    Returns:
        The scene and the angle by which the world was turned about +y [rad].
    """
    fields = checked(at, SceneFields)
    if fields.camera is not None:
        camera = camera_of(get(at, "camera"), camera)
    if camera is None:
        refuse(get(at, "camera"), "a camera, here or in camera.json")
    ground = None if fields.ground is None else fields.ground.height
    if ground is not None and ground >= 0:
        warn(f"{at.file}: the ground is not below the camera (height {ground:g} m)")
    pieces = _pieces_of(get(at, "objects"), fields.objects, load)
    camera, angle = turned(camera)
    check_attitude(camera, at.file, warn)
    layout = None if fields.layout is None else _turned_spots(fields.layout, angle)
    pieces = tuple(_turn(piece, angle) for piece in pieces)
    return Scene(camera, ground, pieces, layout, fields.size_spread), angle


def _pieces_of(at: At, rows: Sequence[ObjectFields], load: LoadMesh) -> list[SceneObject]:
    """All objects of a scene, with their relations checked."""
    ids: set[object] = set()
    annotations: set[object] = set()
    pieces: list[SceneObject] = []
    for item, row in zip(items(at), rows, strict=True):
        check_id(get(item, "id"))
        unique(get(item, "id"), ids, row.id.casefold(), "an id (in any case)")
        if row.annotation is not None:
            unique(get(item, "annotation"), annotations, row.annotation, "an annotation")
        _check_segments(item, row)
        pieces.append(_piece_of(row, *load(get(item, "mesh"))))
    _check_supports(at, pieces)
    return pieces


def check_id(at: At) -> None:
    """Refuse an id that is not safe as the name of a file, or means something else."""
    name = at.value
    if not SAFE_ID.fullmatch(name) or name.casefold() in WORDS or name.endswith("."):
        refuse(at, "letters, digits, '_', '-' or '.', not 'ground' or 'free'")


def _piece_of(row: ObjectFields, mesh: Mesh, file: str) -> SceneObject:
    support = "ground" if row.support is None else str(row.support)
    place = _place_of(row)
    segments = tuple(
        Segment(part.frame, torch.tensor(part.translation), torch.tensor(part.yaw), part.mover)
        for part in row.segments or ()
    )
    name, category = str(row.id), str(row.category)
    return SceneObject(name, category, mesh, file, row.annotation, support, *place, segments)


def _check_segments(at: At, row: ObjectFields) -> None:
    """Segments begin one after the other."""
    frames = [part.frame for part in row.segments or ()]
    for k, (before, after) in enumerate(pairwise(frames), 1):
        if after <= before:
            field = At(after, at.file, f"{at.field}.segments[{k}].frame")
            refuse(field, f"a frame after {before}, in which the segment before begins")


def _place_of(row: PlaceFields) -> tuple[Tensor, Tensor, Tensor]:
    """Translation, yaw and scale."""
    return torch.tensor(row.translation), torch.tensor(row.yaw), torch.tensor(row.scale)


def _check_supports(at: At, pieces: list[SceneObject]) -> None:
    """Each object stands on the ground, is free, or stands on others without a circle."""
    under = {piece.id: piece.support for piece in pieces}
    for i, piece in enumerate(pieces):
        field = At(piece.support, at.file, f"{at.field}[{i}].support")
        below, seen = piece.support, {piece.id}
        while below not in WORDS:
            if below not in under:
                refuse(field, "'ground', 'free' or the id of an object", f"{below!r}")
            if below in seen:
                refuse(field, "supports that end at the ground", "a circle of supports")
            seen.add(below)
            below = under[below]


def _turned_spots(spots: Sequence[Spot], angle: float) -> Float[Tensor, "spots 2"]:
    """Places on the floor, turned about +y."""
    flat = torch.tensor(spots, dtype=torch.float64)
    turn = rot_y(torch.tensor(angle, dtype=torch.float64))[::2, ::2]
    return (flat @ turn.mT).float()


def _turn(piece: SceneObject, angle: float) -> SceneObject:
    if not angle:
        return piece
    turn = torch.tensor(angle, dtype=torch.float64)

    def turned_by(place: P) -> P:
        t = (rot_y(turn) @ place.t_world_object.double()).to(place.t_world_object)
        yaw = wrap(place.yaw.double() + turn).to(place.yaw)
        return dataclasses.replace(place, t_world_object=t, yaw=yaw)

    segments = tuple(turned_by(segment) for segment in piece.segments)
    return dataclasses.replace(turned_by(piece), segments=segments)


def scene_tree(
    objects: Sequence[Mapping[str, Any]],
    file: str,
    ground: float | None = None,
    layout: list[list[float]] | None = None,
) -> At:
    """scene.json of objects that a reader found.

    Args:
        objects: Their fields.
        file: How messages call it.
        ground: Its height [m].
        layout: Four corners of the room on the floor, (x, z) [m].
    """
    below = {} if ground is None else {"ground": {"height": ground}}
    below |= {} if layout is None else {"layout": layout}
    return At({"format": FORMAT, "version": VERSION, **below, "objects": list(objects)}, file)


def write_scene(
    scene: Scene, path: Path, more: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write a scene: the user's meshes are copied as they are, new ones become meshes/<id>.glb.

    The copy of a mesh whose seat was raised keeps parts, materials and textures (`stretch_file`).

    Args:
        scene: What is written.
        path: The file; `meshes/` goes beside it.
        more: Further fields of the objects, by their ids; `read_scene` does not look at them.
    """
    meshes = path.parent / "meshes"
    objects: list[dict[str, Any]] = []
    for piece in scene.objects:
        source = Path(piece.mesh_file)
        if source.is_absolute() and source.is_file():
            target = copy_mesh(source, meshes, piece.id)
            if piece.stretch is not None:
                target = stretch_file(target, piece.stretch)
        else:
            target = meshes / f"{piece.id}.glb"
            write_mesh(piece.mesh, target)
        fields = _object_to_json(piece, target.relative_to(path.parent).as_posix())
        objects.append(fields | dict((more or {}).get(piece.id, {})))
    layout = None if scene.layout is None else [plain(spot) for spot in scene.layout]
    tree: dict[str, Any] = scene_tree(objects, "scene.json", scene.ground, layout).value
    head = {key: tree.pop(key) for key in ("format", "version")}
    spread = {"size_spread": scene.size_spread} if scene.size_spread else {}
    write_json({**head, "camera": camera_to_json(scene.camera), **spread, **tree}, path)


def _object_to_json(piece: SceneObject, mesh: str) -> dict[str, Any]:
    annotation = {} if piece.annotation is None else {"annotation": piece.annotation}
    segments = [
        {"frame": s.frame, "translation": plain(s.t_world_object), "yaw": plain(s.yaw)}
        | ({} if s.mover is None else {"mover": s.mover})
        for s in piece.segments
    ]
    return {
        "id": piece.id, "category": piece.category, "mesh": mesh, **annotation,
        "translation": plain(piece.t_world_object), "yaw": plain(piece.yaw),
        "scale": plain(piece.scale), "support": piece.support,
        **({"segments": segments} if segments else {}),
    }  # fmt: skip


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

    Args:
        at: The content of the file.
        load: Gives the mesh that a field names.
        scene: The scene beside the file.
        warn: Takes what is odd but not wrong.
    """
    objects, own = get(at, "objects"), {piece.id: piece for piece in scene.objects}
    found: list[SceneObject] = []
    stale: list[str] = []
    for name, rows in checked(at, HypothesesFields).objects.items():
        if name not in own or not rows or not _is_at(rows[0], own[name]):
            stale.append(name)
            continue
        places = items(get(objects, name))
        pairs = zip(rows[1:], places[1:], strict=True)
        for row, place in pairs:
            mesh, file = load(get(place, "mesh"))
            t, yaw, scale = _place_of(row)
            where = {"t_world_object": t, "yaw": yaw, "scale": scale}
            found.append(replace(own[name], mesh=mesh, mesh_file=file, **where))
    if stale:
        warn(f"{at.file}: not of this scene, so not used: {listed('object', stale)}")
    return tuple(found)


def _is_at(row: PlaceFields, piece: SceneObject) -> bool:
    """Whether a row is where the scene has the object."""
    t, yaw, _ = _place_of(row)
    away = (t - piece.t_world_object).norm()
    return float(away) < SAME and float(wrap(yaw - piece.yaw).abs()) < SAME


def write_hypotheses(
    folder: Path,
    groups: Mapping[str, Sequence[SceneObject]],
    energies: Mapping[str, Sequence[float]],
) -> None:
    """Write hypotheses.json beside a scene.json that is written already, and their meshes.

    Args:
        folder: The capture folder.
        groups: Of each object, best first; the first is the one in the scene.
        energies: What is left of the image terms at each, where that is known.
    """
    scene = json.loads((folder / "scene.json").read_text())
    meshes = {row["id"]: row["mesh"] for row in scene["objects"]}
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, group in groups.items():
        names = [meshes[name]]
        for rank, piece in enumerate(group[1:], 1):
            names.append(f"meshes/other/{name}_{rank}.glb")
            write_mesh(piece.mesh, folder / names[-1])
        rows[name] = [
            {"mesh": mesh, "translation": plain(piece.t_world_object), "yaw": plain(piece.yaw),
             "scale": plain(piece.scale)}
            for mesh, piece in zip(names, group, strict=True)
        ]  # fmt: skip
        for row, energy in zip(rows[name], energies.get(name, ()), strict=False):
            row["energy"] = energy
    write_json(
        {"format": "mover-hypotheses", "version": VERSION, "objects": rows},
        folder / HYPOTHESES,
    )
