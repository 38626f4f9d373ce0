"""A user's corrections of a room as a list that replays (edits.json, docs/view.md).

An edit holds the pose of an object in the world of the result that the user looked at; the camera
of that world stands in the edit, so that it can be carried to any other estimate of the camera.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from msgspec import Meta, Struct, to_builtins
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Capture, Scene, SceneObject
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted, to_camera, to_world
from mover.io.files.fields import plain, read_json, write_json
from mover.io.files.schema import Number, Sizes, Vector, checked


class _Edit(Struct, frozen=True, tag_field="do"):
    id: str


class Place(_Edit, frozen=True, tag="place"):
    """Move, turn or resize an object: x_world = R_y(yaw) @ (scale * x_mesh) + translation."""

    translation: Vector
    """Position of the mesh origin [m]."""
    yaw: Number
    """[rad]."""
    scale: Sizes
    """Factor along each mesh axis."""
    pitch: Annotated[float, Meta(ge=-1.6, le=1.6)]
    """Of the camera in whose world this is [rad]."""
    roll: Annotated[float, Meta(ge=-3.2, le=3.2)]
    """[rad]."""


class Pin(_Edit, frozen=True, tag="pin"):
    """Keep an object where it starts, or let it go again."""

    pinned: bool


class Delete(_Edit, frozen=True, tag="delete"):
    """Take an object out of the room; what it carried gets its support."""


Edit = Place | Pin | Delete


class EditsFields(Struct, frozen=True):
    """edits.json."""

    format: Literal["mover-edits"]
    version: Literal[1]
    edits: list[Edit]


def apply_edits(capture: Capture, edits: Sequence[Edit]) -> tuple[Capture, tuple[str, ...]]:
    """The capture with its initial scene edited, and the ids of the pinned objects."""
    scene = edit_scene(capture.scene, edits)
    return replace(capture, scene=scene), pinned_ids(scene, edits)


def edit_scene(scene: Scene, edits: Sequence[Edit]) -> Scene:
    """The scene after the edits, which are carried from their worlds to its own.

    Raises:
        InputError: If an edit names an object that is not there.
    """
    objects = {one.id: one for one in scene.objects}
    for index, edit in enumerate(edits):
        if edit.id not in objects:
            known = ", ".join(objects) or "none"
            found = f"edits[{index}] has {edit.id!r}"
            raise InputError(f"{found}, expected an object of the scene: {known}")
        if isinstance(edit, Place):
            given = (edit.translation, edit.yaw, edit.scale)
            t, yaw, scale = (torch.tensor(value).float() for value in given)
            put = replace(objects[edit.id], t_world_object=t, yaw=yaw, scale=scale, segments=())
            old, new = tilted(*torch.tensor([edit.pitch, edit.roll])), scene.camera.R_cam_world
            # The front is the level direction that `recast` turns back into the edit's: a pinned
            # object returns exactly when a run finds that camera.
            front, up_old, up_new = old @ facing(yaw), old[:, 1], new[:, 1]
            front = front - up_old * (front @ up_new) / (up_old @ up_new)
            objects[edit.id] = carried(put, front, old, new)
        elif isinstance(edit, Delete):
            below = objects.pop(edit.id).support
            above = [key for key, one in objects.items() if one.support == edit.id]
            objects |= {key: replace(objects[key], support=below) for key in above}
    return replace(scene, objects=tuple(objects.values()))


def pinned_ids(scene: Scene, edits: Sequence[Edit]) -> tuple[str, ...]:
    """The objects of the edited scene that are pinned, in the order of the scene."""
    pinned = {edit.id: edit.pinned for edit in edits if isinstance(edit, Pin)}
    return tuple(one.id for one in scene.objects if pinned.get(one.id, False))


def placement_of(one: SceneObject, scene: Scene) -> Place:
    """The edit that puts an object where it is in a scene."""
    pitch, roll = pitch_roll(scene.camera.R_cam_world)
    t, yaw, scale = (plain(x) for x in (one.t_world_object, one.yaw, one.scale))
    return Place(one.id, tuple(t), yaw, tuple(scale), float(pitch), float(roll))


def joined(edits: Sequence[Edit], new: Edit) -> tuple[Edit, ...]:
    """The list with one edit more; a placement replaces one of the same object just before it."""
    last = edits[-1] if edits else None
    if isinstance(last, Place) and isinstance(new, Place) and last.id == new.id:
        return (*edits[:-1], new)
    return (*edits, new)


def facing(yaw: Float[Tensor, ""]) -> Float[Tensor, "3"]:
    """The front of an upright object in the world."""
    return torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])


def carried(
    one: SceneObject, front: Float[Tensor, "3"], old: Float[Tensor, "3 3"],
    new: Float[Tensor, "3 3"],
) -> SceneObject:  # fmt: skip
    """The object in the world that another tilt of the camera (R_cam_world) gives.

    Its box keeps its centre in the camera frame, and it faces a direction of that frame.
    """
    center, level = to_world(to_camera(box_of(one).center, old), new), to_world(front, new)
    turned = replace(one, yaw=torch.atan2(level[0], level[2]))
    return replace(turned, t_world_object=one.t_world_object + center - box_of(turned).center)


def read_edits(path: Path) -> tuple[Edit, ...]:
    """Read and check a list of edits; whether their objects exist is checked when they apply."""
    return tuple(checked(read_json(path), EditsFields).edits)


def write_edits(edits: tuple[Edit, ...], path: Path) -> None:
    """Write the list, all at once."""
    write_json(to_builtins(EditsFields("mover-edits", 1, list(edits))), path)
