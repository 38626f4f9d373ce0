"""A user's corrections of a room as a list that replays.

An edit says where an object stands in the world of the result that the user looked at; the camera
of that world stands in the edit, so that it can be carried to any other guess of the camera.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from msgspec import Meta, Struct, to_builtins

from mover.core.errors import InputError
from mover.core.types import Capture, Scene, SceneObject
from mover.furniture.library import PIECES, STYLES, make_piece
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted, to_camera, to_world
from mover.io.capture.scene_file import check_id
from mover.io.files.fields import (
    At,
    choice,
    get,
    integer,
    items,
    mapping,
    plain,
    read_json,
    text,
    write_json,
)
from mover.io.files.schema import Id, Number, Sizes, Vector, checked


class Placement(Struct, frozen=True):
    """Where an object stands: x_world = R_y(yaw) @ (scale * x_mesh) + translation."""

    translation: Vector
    """Place of the mesh origin [m]."""
    yaw: Number
    """[rad]."""
    scale: Sizes
    """Factor along each mesh axis."""
    pitch: Annotated[float, Meta(ge=-1.6, le=1.6)]
    """Of the camera in whose world this is [rad]."""
    roll: Annotated[float, Meta(ge=-3.2, le=3.2)]
    """[rad]."""


class _Edit(Struct, frozen=True, tag_field="do"):
    id: str


class Place(_Edit, frozen=True, tag="place"):
    """Put an object somewhere, turn it, resize it."""

    at: Placement


class Relabel(_Edit, frozen=True, tag="relabel"):
    """Say what an object is."""

    category: str


class Pin(_Edit, frozen=True, tag="pin"):
    """Keep an object where it starts, or let it go again."""

    pinned: bool


class Delete(_Edit, frozen=True, tag="delete"):
    """Take an object out of the room; what it carried stands where it stood."""


class Add(_Edit, frozen=True, tag="add"):
    """Put a piece of the library into the room."""

    piece: str
    """A name of `furniture.library.PIECES`."""
    style: Id
    seed: Id
    """Draws its sizes."""
    annotation: Id | None
    """The detection that shows it; None: only people tell where it stands."""
    at: Placement


Edit = Place | Relabel | Pin | Delete | Add


def apply_edits(capture: Capture, edits: Sequence[Edit]) -> tuple[Capture, tuple[str, ...]]:
    """The capture with its initial scene edited, and the ids of the pinned objects.

    Raises:
        InputError: If an edit names an object that is not there, or adds one that is.
    """
    scene = edit_scene(capture.scene, edits)
    return replace(capture, scene=scene), pinned_ids(scene, edits)


def edit_scene(scene: Scene, edits: Sequence[Edit]) -> Scene:
    """The scene after the edits, in its own world.

    Raises:
        InputError: If an edit names an object that is not there, or adds one that is.
    """
    pieces = {piece.id: piece for piece in scene.objects}
    for index, edit in enumerate(edits):
        _check(edit, index, pieces)
        match edit:
            case Place():
                pieces[edit.id] = _placed(pieces[edit.id], edit.at, scene)
            case Relabel():
                pieces[edit.id] = replace(pieces[edit.id], category=edit.category)
            case Add():
                pieces[edit.id] = _placed(_new(edit, index), edit.at, scene)
            case Delete():
                pieces = _without(edit.id, pieces)
            case Pin():
                pass
    return replace(scene, objects=tuple(pieces.values()))


def pinned_ids(scene: Scene, edits: Sequence[Edit]) -> tuple[str, ...]:
    """The objects of the edited scene that are pinned, in the order of the scene."""
    pinned: dict[str, bool] = {}
    for edit in edits:
        if isinstance(edit, Pin):
            pinned[edit.id] = edit.pinned
        elif isinstance(edit, Add | Delete):
            pinned[edit.id] = False
    return tuple(piece.id for piece in scene.objects if pinned.get(piece.id, False))


def placement_of(piece: SceneObject, scene: Scene) -> Placement:
    """Where a piece of a scene stands, as an edit says it."""
    pitch, roll = pitch_roll(scene.camera.R_cam_world)
    t, yaw, scale = (plain(x) for x in (piece.t_world_object, piece.yaw, piece.scale))
    return Placement(tuple(t), yaw, tuple(scale), float(pitch), float(roll))


def joined(edits: Sequence[Edit], new: Edit) -> tuple[Edit, ...]:
    """The list with one edit more; a placement takes the place of one just before it."""
    last = edits[-1] if edits else None
    if isinstance(last, Place) and isinstance(new, Place) and last.id == new.id:
        return (*edits[:-1], new)
    return (*edits, new)


def _check(edit: Edit, index: int, pieces: dict[str, SceneObject]) -> None:
    place = f"edits[{index}]"
    if not isinstance(edit, Add):
        if edit.id not in pieces:
            known = ", ".join(pieces) or "none"
            raise InputError(f"{place} has {edit.id!r}, expected an object of the scene: {known}")
        return
    if edit.id.casefold() in {name.casefold() for name in pieces}:
        raise InputError(f"{place} adds {edit.id!r}, which is there already, expected a new id")
    taken = {piece.annotation: piece.id for piece in pieces.values()}
    if edit.annotation is not None and edit.annotation in taken:
        owner = taken[edit.annotation]
        raise InputError(f"{place} has annotation {edit.annotation}, which {owner!r} has")


def _new(edit: Add, index: int) -> SceneObject:
    try:
        made = make_piece(edit.piece, np.random.default_rng(edit.seed), edit.style)
    except ValueError as error:
        raise InputError(f"edits[{index}]: {error}") from error
    place = torch.zeros(3), torch.tensor(0.0), torch.ones(3)
    return SceneObject(edit.id, edit.piece, made.mesh, "", edit.annotation, "ground", *place)


def _without(name: str, pieces: dict[str, SceneObject]) -> dict[str, SceneObject]:
    below = pieces[name].support
    return {
        key: replace(piece, support=below) if piece.support == name else piece
        for key, piece in pieces.items()
        if key != name
    }


def _placed(piece: SceneObject, at: Placement, scene: Scene) -> SceneObject:
    """The piece where an edit puts it, carried from the edit's world to that of the scene.

    Its box keeps its centre in the camera frame. Its front is the level direction that `recast`
    turns back into the edit's: a pinned object comes home exactly when a run finds that camera.
    """
    t, yaw, scale = (torch.tensor(x).float() for x in (at.translation, at.yaw, at.scale))
    put = replace(piece, t_world_object=t, yaw=yaw, scale=scale, segments=())
    old, new = tilted(torch.tensor(at.pitch), torch.tensor(at.roll)), scene.camera.R_cam_world
    center = to_world(to_camera(box_of(put).center, old), new)
    front = old @ torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
    up_old, up_new = old[:, 1], new[:, 1]
    level = to_world(front - up_old * (front @ up_new) / (up_old @ up_new), new)
    turned = replace(put, yaw=torch.atan2(level[0], level[2]))
    return replace(turned, t_world_object=put.t_world_object + center - box_of(turned).center)


# edits.json: a user's corrections of a room, in their order (docs/view.md).


FORMAT, VERSION = "mover-edits", 1


class EditsFields(Struct, frozen=True):
    """edits.json."""

    format: Literal["mover-edits"]
    version: Literal[1]
    edits: list[Any]


def read_edits(path: Path) -> tuple[Edit, ...]:
    """Read and check a list of edits; whether their objects exist shows when they are applied."""
    at = read_json(path)
    checked(at, EditsFields)
    return tuple(_edit_of(item) for item in items(get(at, "edits")))


def _edit_of(at: At) -> Edit:
    """An edit; where it places something, its row has the fields of the placement."""
    row = mapping(at)
    if row.get("do") in ("place", "add", "dismiss"):
        row = {"annotation": None, **row, "at": checked(at, Placement)}
    edit: Edit = checked(At(row, at.file, at.field), Edit)
    text(get(at, "id"))
    match edit:
        case Relabel():
            text(get(at, "category"))
        case Add():
            check_id(get(at, "id"))
            choice(get(at, "piece"), tuple(PIECES))
            integer(get(at, "style"), 0, STYLES[edit.piece] - 1)
        case _:
            pass
    return edit


def write_edits(edits: tuple[Edit, ...], path: Path) -> None:
    """Write the list, all at once."""
    rows: list[dict[str, Any]] = [to_builtins(edit) for edit in edits]
    flat = [
        {k: v for k, v in (row | row.get("at", {})).items() if k != "at" and v is not None}
        for row in rows
    ]
    write_json({"format": FORMAT, "version": VERSION, "edits": flat}, path)
