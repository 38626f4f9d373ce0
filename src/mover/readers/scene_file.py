"""scene.json: the initial scene, the result and the truth."""

import dataclasses
import logging
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from ..geometry.rotations import rot_y, wrap
from ..types import Camera, Mesh, Piece, Scene
from .camera_file import camera_of, camera_to_json, check_attitude, turned
from .fields import (
    LAST_ID,
    At,
    Warn,
    choice,
    get,
    integer,
    items,
    maybe,
    number,
    plain,
    positive,
    read_json,
    refuse,
    text,
    unique,
    vector,
    write_json,
)
from .mesh_file import copy_mesh, read_mesh, write_mesh

log = logging.getLogger(__name__)

FORMAT, VERSION = "mover-scene", 1
SAFE_ID = re.compile(r"\w[\w.-]{0,99}")
WORDS = ("ground", "free")
LoadMesh = Callable[[At], tuple[Mesh, str]]
"""Gives the mesh that a field names, and its file."""


def read_scene(path: Path, camera: Camera | None = None, warn: Warn = log.warning) -> Scene:
    """Read and check a scene and its meshes.

    Args:
        path: Of scene.json; meshes are relative to its folder.
        camera: Used where the file has none.
        warn: Takes what is odd but not wrong.

    Raises:
        InputError: If anything in it is wrong.
    """

    def load(at: At) -> tuple[Mesh, str]:
        return read_mesh(at, path.parent)

    return scene_of(read_json(path), load, camera, warn)[0]


def scene_of(at: At, load: LoadMesh, camera: Camera | None, warn: Warn) -> tuple[Scene, float]:
    """The scene of a JSON object, in the world where the camera has no heading.

    Returns:
        The scene and the angle by which the world was turned about +y [rad].
    """
    choice(get(at, "format"), (FORMAT,))
    integer(get(at, "version"), VERSION, VERSION)
    own = maybe(at, "camera")
    if own is None and camera is None:
        refuse(get(at, "camera"), "a camera, here or in camera.json")
    if own is not None:
        camera = camera_of(own, camera)
    assert camera is not None
    given, ground = maybe(at, "ground"), None
    if given is not None:
        ground = number(get(given, "height"))
        if ground >= 0:
            warn(f"{at.file}: the ground is not below the camera (height {ground:g} m)")
    pieces = _pieces_of(get(at, "objects"), load)
    camera, angle = turned(camera)
    check_attitude(camera, at.file, warn)
    return Scene(camera, ground, tuple(_turn(piece, angle) for piece in pieces)), angle


def _pieces_of(at: At, load: LoadMesh) -> list[Piece]:
    """All objects of a scene, with their relations checked."""
    ids: set[object] = set()
    annotations: set[object] = set()
    pieces: list[Piece] = []
    for item in items(at):
        piece = _piece_of(item, load)
        unique(get(item, "id"), ids, piece.id.casefold(), "an id (in any case)")
        if piece.annotation is not None:
            unique(get(item, "annotation"), annotations, piece.annotation, "an annotation")
        pieces.append(piece)
    _check_supports(at, pieces)
    return pieces


def _piece_of(at: At, load: LoadMesh) -> Piece:
    """One object."""
    name = text(get(at, "id"))
    if not SAFE_ID.fullmatch(name) or name.casefold() in WORDS or name.endswith("."):
        refuse(get(at, "id"), "letters, digits, '_', '-' or '.', not 'ground' or 'free'")
    annotation, support = maybe(at, "annotation"), maybe(at, "support")
    mesh, file = load(get(at, "mesh"))
    return Piece(
        id=name,
        category=text(get(at, "category")),
        mesh=mesh,
        mesh_file=file,
        annotation=None if annotation is None else integer(annotation, 0, LAST_ID),
        support="ground" if support is None else text(support),
        t_world_object=torch.tensor(vector(get(at, "translation"), 3)),
        yaw=torch.tensor(number(get(at, "yaw"))),
        scale=torch.tensor([positive(v) for v in items(get(at, "scale"), 3)]),
    )


def _check_supports(at: At, pieces: list[Piece]) -> None:
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


def _turn(piece: Piece, angle: float) -> Piece:
    """The object in the world turned about +y."""
    if not angle:
        return piece
    turn = torch.tensor(angle, dtype=torch.float64)
    place = rot_y(turn) @ piece.t_world_object.double()
    yaw = wrap(piece.yaw.double() + turn)
    return dataclasses.replace(
        piece, t_world_object=place.to(piece.t_world_object), yaw=yaw.to(piece.yaw)
    )


def write_scene(
    scene: Scene, path: Path, more: Mapping[str, Mapping[str, Any]] | None = None
) -> None:
    """Write a scene: the user's meshes are copied as they are, new ones become meshes/<id>.glb.

    Args:
        scene: What is written.
        path: The file; `meshes/` goes beside it.
        more: Further fields of the objects, by their ids; `read_scene` does not look at them.
    """
    meshes = path.parent / "meshes"
    objects: list[dict[str, Any]] = []
    for piece in scene.pieces:
        source = Path(piece.mesh_file)
        if source.is_absolute() and source.is_file():
            target = copy_mesh(source, meshes, piece.id)
        else:
            target = meshes / f"{piece.id}.glb"
            write_mesh(piece.mesh, target)
        fields = _piece_to_json(piece, target.relative_to(path.parent).as_posix())
        objects.append(fields | dict((more or {}).get(piece.id, {})))
    tree: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    tree["camera"] = camera_to_json(scene.camera)
    if scene.ground is not None:
        tree["ground"] = {"height": scene.ground}
    write_json({**tree, "objects": objects}, path)


def _piece_to_json(piece: Piece, mesh: str) -> dict[str, Any]:
    """The JSON object of a piece."""
    annotation = {} if piece.annotation is None else {"annotation": piece.annotation}
    return {
        "id": piece.id, "category": piece.category, "mesh": mesh, **annotation,
        "translation": plain(piece.t_world_object), "yaw": plain(piece.yaw),
        "scale": plain(piece.scale), "support": piece.support,
    }  # fmt: skip
