"""A user's corrections of a room as a list that replays: place, relabel, pin, delete, add.

An edit says where an object stands in the world of the result that the user looked at; the camera
of that world stands in the edit, so that it can be carried to any other guess of the camera.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Capture, Scene, SceneObject
from mover.furniture.library import PIECES, STYLES, make_piece
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted, to_camera, to_world
from mover.io.capture.scene_file import check_id
from mover.io.files.fields import At, choice, get, integer, items, plain, read_json, write_json
from mover.io.files.schema import Id, Number, Sizes, Text, Vector, checked


@record
class Placement:
    """Where an object stands: x_world = R_y(yaw) @ (scale * x_mesh) + t_world_object."""

    t_world_object: Float[Tensor, "3"]
    """Place of the mesh origin [m]."""
    yaw: Float[Tensor, ""]
    """[rad]."""
    scale: Float[Tensor, "3"]
    """Factor along each mesh axis."""
    pitch: float
    """Of the camera in whose world this is [rad]."""
    roll: float
    """[rad]."""


@record
class Place:
    """Put an object somewhere, turn it, resize it."""

    id: str
    at: Placement


@record
class Relabel:
    """Say what an object is."""

    id: str
    category: str


@record
class Pin:
    """Keep an object where it starts, or let it go again."""

    id: str
    pinned: bool


@record
class Delete:
    """Take an object out of the room; what it carried stands where it stood."""

    id: str


@record
class Add:
    """Put a piece of the library into the room."""

    id: str
    piece: str
    """A name of `furniture.library.PIECES`."""
    style: int
    seed: int
    """Draws its sizes."""
    annotation: int | None
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
    return Placement(
        piece.t_world_object, piece.yaw, piece.scale, pitch=float(pitch), roll=float(roll)
    )


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
    at = edit.at
    return SceneObject(
        edit.id, edit.piece, made.mesh, "", edit.annotation, "ground", at.t_world_object, at.yaw,
        at.scale,
    )  # fmt: skip


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
    put = replace(piece, t_world_object=at.t_world_object, yaw=at.yaw, scale=at.scale)
    old, new = tilted(torch.tensor(at.pitch), torch.tensor(at.roll)), scene.camera.R_cam_world
    center = to_world(to_camera(box_of(put).center, old), new)
    front = old @ torch.stack([at.yaw.sin(), torch.zeros_like(at.yaw), at.yaw.cos()])
    up_old, up_new = old[:, 1], new[:, 1]
    level = to_world(front - up_old * (front @ up_new) / (up_old @ up_new), new)
    turned = replace(put, yaw=torch.atan2(level[0], level[2]))
    return replace(turned, t_world_object=put.t_world_object + center - box_of(turned).center)


# edits.json: a user's corrections of a room, in their order (docs/view.md).


FORMAT, VERSION = "mover-edits", 1


class _Edit(Struct, frozen=True, tag_field="do"):
    id: Text


class PlaceFields(_Edit, frozen=True, tag="place"):
    """An object's place, and the camera of its world."""

    translation: Vector
    yaw: Number
    scale: Sizes
    pitch: Annotated[float, Meta(ge=-1.6, le=1.6)]
    roll: Annotated[float, Meta(ge=-3.2, le=3.2)]


class AddFields(PlaceFields, frozen=True, tag="add"):
    """A piece of the library."""

    piece: Text
    style: Id
    seed: Id
    annotation: Id | None = None


class RelabelFields(_Edit, frozen=True, tag="relabel"):
    """What an object is."""

    category: Text


class PinFields(_Edit, frozen=True, tag="pin"):
    """Whether it stays."""

    pinned: bool


class DeleteFields(_Edit, frozen=True, tag="delete"):
    """Which one goes."""


EditFields = PlaceFields | RelabelFields | PinFields | DeleteFields | AddFields


class EditsFields(Struct, frozen=True):
    """edits.json."""

    format: Literal["mover-edits"]
    version: Literal[1]
    edits: list[EditFields]


def read_edits(path: Path) -> tuple[Edit, ...]:
    """Read and check a list of edits; whether their objects exist shows when they are applied.

    Raises:
        InputError: If anything in it is wrong.
    """
    at = read_json(path)
    rows = checked(at, EditsFields).edits
    places = items(get(at, "edits"))
    return tuple(_edit_of(place, row) for place, row in zip(places, rows, strict=True))


def write_edits(edits: tuple[Edit, ...], path: Path) -> None:
    """Write the list, all at once."""
    tree = {"format": FORMAT, "version": VERSION, "edits": [_edit_to_json(e) for e in edits]}
    write_json(tree, path)


def _placement_of(row: PlaceFields) -> Placement:
    return Placement(
        torch.tensor(row.translation), torch.tensor(row.yaw), torch.tensor(row.scale),
        pitch=row.pitch, roll=row.roll,
    )  # fmt: skip


def _edit_of(at: At, row: EditFields) -> Edit:
    match row:
        case RelabelFields():
            return Relabel(row.id, row.category)
        case PinFields():
            return Pin(row.id, row.pinned)
        case DeleteFields():
            return Delete(row.id)
        case AddFields():
            check_id(get(at, "id"))
            choice(get(at, "piece"), tuple(PIECES))
            integer(get(at, "style"), 0, STYLES[row.piece] - 1)
            place = _placement_of(row)
            return Add(row.id, row.piece, row.style, row.seed, row.annotation, place)
        case PlaceFields():
            return Place(row.id, _placement_of(row))


def _edit_to_json(edit: Edit) -> dict[str, Any]:
    match edit:
        case Place():
            return {"do": "place", "id": edit.id, **_placement_to_json(edit.at)}
        case Relabel():
            return {"do": "relabel", "id": edit.id, "category": edit.category}
        case Pin():
            return {"do": "pin", "id": edit.id, "pinned": edit.pinned}
        case Delete():
            return {"do": "delete", "id": edit.id}
        case Add():
            shown = {} if edit.annotation is None else {"annotation": edit.annotation}
            made = {"piece": edit.piece, "style": edit.style, "seed": edit.seed, **shown}
            return {"do": "add", "id": edit.id, **made, **_placement_to_json(edit.at)}


def _placement_to_json(at: Placement) -> dict[str, Any]:
    return {
        "translation": plain(at.t_world_object), "yaw": plain(at.yaw), "scale": plain(at.scale),
        "pitch": at.pitch, "roll": at.roll,
    }  # fmt: skip
