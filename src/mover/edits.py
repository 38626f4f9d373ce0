"""A user's corrections of a room as a list that replays: place, relabel, pin, delete, add.

An edit says where an object stands in the world of the result that the user looked at; the camera
of that world stands in the edit, so that it can be carried to any other guess of the camera.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .furniture.library import make_piece
from .geometry.boxes import box_of
from .geometry.camera import pitch_roll, tilted, to_camera, to_world
from .records import InputError, record
from .types import Capture, Piece, Scene


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
    pieces = {piece.id: piece for piece in scene.pieces}
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
    return replace(scene, pieces=tuple(pieces.values()))


def pinned_ids(scene: Scene, edits: Sequence[Edit]) -> tuple[str, ...]:
    """The objects of the edited scene that are pinned, in the order of the scene."""
    pinned: dict[str, bool] = {}
    for edit in edits:
        if isinstance(edit, Pin):
            pinned[edit.id] = edit.pinned
        elif isinstance(edit, Add | Delete):
            pinned[edit.id] = False
    return tuple(piece.id for piece in scene.pieces if pinned.get(piece.id, False))


def placement_of(piece: Piece, scene: Scene) -> Placement:
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


def _check(edit: Edit, index: int, pieces: dict[str, Piece]) -> None:
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


def _new(edit: Add, index: int) -> Piece:
    try:
        made = make_piece(edit.piece, np.random.default_rng(edit.seed), edit.style)
    except ValueError as error:
        raise InputError(f"edits[{index}]: {error}") from error
    at = edit.at
    return Piece(
        edit.id, edit.piece, made.mesh, "", edit.annotation, "ground", at.t_world_object, at.yaw,
        at.scale,
    )  # fmt: skip


def _without(name: str, pieces: dict[str, Piece]) -> dict[str, Piece]:
    below = pieces[name].support
    return {
        key: replace(piece, support=below) if piece.support == name else piece
        for key, piece in pieces.items()
        if key != name
    }


def _placed(piece: Piece, at: Placement, scene: Scene) -> Piece:
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
