"""Capture folders (FORMAT.md): camera, initial scene, annotations, bodies, people."""

import dataclasses
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.core.types import Camera, Capture, DepthImage
from mover.geometry.path import is_still
from mover.io.capture.annotations_file import (
    detections_to_json,
    furniture_to_json,
    image_name,
    people_to_json,
)
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.build import build_capture
from mover.io.capture.camera_file import camera_to_json, path_to_arrays
from mover.io.capture.parts import Hints, LoadImage, Parts, image_parts
from mover.io.capture.scene_file import HYPOTHESES, write_hypotheses, write_scene
from mover.io.files.fields import At, read_json, write_json
from mover.io.files.images import (
    DEPTH,
    DISPARITY,
    find_depth_file,
    read_depth_image,
    read_image,
    write_depth_image,
    write_image,
)
from mover.io.files.meshes import read_mesh
from mover.io.files.npz import read_npz, write_npz

REFERENCE, FURNITURE = "reference.jpg", "furniture.json"


def read_capture(folder: Path) -> Capture:
    """Read and check a capture folder; its truth is not looked at."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a capture")
    parts = _files(folder, read_json)
    assert parts.objects is not None
    named = image_name(parts.objects)
    if named is None and (folder / REFERENCE).is_file():
        named = At(REFERENCE, "objects.json", "images[0].file_name")
    if named is None:
        return build_capture(parts)
    return build_capture(dataclasses.replace(parts, load_image=partial(read_image, named, folder)))


def folder_parts(folder: Path, hints: Hints | None = None) -> Parts:
    """What is already in a capture's folder; the camera of scene.json is taken out of it."""
    del hints
    parts = _files(folder, partial(_if_there, read_json))
    camera, scene = parts.camera, parts.scene
    if scene is not None and isinstance(scene.value, dict):
        own: Any = scene.value.get("camera")
        base: Any = {} if camera is None else camera.value
        if isinstance(own, dict) and isinstance(base, dict):
            camera = At({**base, **own}, scene.file, "camera")
        scene = At({k: v for k, v in scene.value.items() if k != "camera"}, scene.file)
    load, size = _reference(folder, parts.objects)
    return dataclasses.replace(
        parts, camera=camera, scene=scene, load_image=load, image_size=size,
        n_frames=None, hypotheses=None, furniture=None,  # they may be of what is replaced
        copies=_measured(folder),
    )  # fmt: skip


def _files(folder: Path, needed: Callable[[Path], At | None]) -> Parts:
    """The files of a folder as they are; `needed` reads those that a capture cannot lack."""
    return Parts(
        name=folder.resolve().name,
        camera=needed(folder / "camera.json"),
        scene=needed(folder / "scene.json"),
        objects=needed(folder / "objects.json"),
        people=_if_there(read_json, folder / "people.json"),
        furniture=_if_there(read_json, folder / FURNITURE),
        bodies=_if_there(read_npz, folder / "bodies.npz"),
        contacts=_if_there(read_npz, folder / "contacts.npz"),
        cameras=_if_there(read_npz, folder / "cameras.npz"),
        load_mesh=partial(read_mesh, folder=folder),
        load_depth=partial(_depth_in, folder),
        n_frames=_count_frames(folder / "frames"),
        hypotheses=_if_there(read_json, folder / HYPOTHESES),
    )


def _measured(folder: Path) -> dict[str, Path]:
    """The measured depth of a folder, by its place in a capture."""
    found = find_depth_file(folder)
    if found is None:
        return {}
    return {f"{DEPTH if found[1] else DISPARITY}/000000{found[0].suffix.lower()}": found[0]}


def _depth_in(folder: Path, camera: Camera) -> DepthImage | None:
    found = find_depth_file(folder)
    return None if found is None else read_depth_image(found[0], camera, metric=found[1])


def _reference(folder: Path, objects: At | None) -> tuple[LoadImage | None, tuple[int, int] | None]:
    names = ["reference.png", REFERENCE]
    named = None if objects is None else image_name(objects)
    if named is not None and isinstance(named.value, str):
        names = [named.value, *names]
    for name in names:
        path = (folder / name).resolve()
        if path.is_relative_to(folder.resolve()) and path.is_file():
            return image_parts(path)
    return None, None


def _if_there(read: Callable[[Path], At], path: Path) -> At | None:
    return read(path) if path.exists() or path.is_symlink() else None


def _count_frames(folder: Path) -> int | None:
    """One more than the last numbered picture, None without pictures."""
    if not folder.is_dir():
        return None
    names = (re.fullmatch(r"([0-9]{6,8})\.(jpg|jpeg|png)", p.name) for p in folder.iterdir())
    numbers = [int(name[1]) for name in names if name]
    return max(numbers) + 1 if numbers else None


def write_capture(capture: Capture, folder: Path) -> None:
    """Write a capture folder, without frames; reading it gives the same capture.

    The picture is kept with 8 bits a channel.

    Raises:
        ValueError: If the folder has a file that this capture lacks: the two would mix.
    """
    _check_room_for(capture, folder)
    name = None
    if capture.reference is not None:
        name = "reference.png"
        write_image(capture.reference, folder / name)
    if capture.bodies is not None:
        write_bodies(capture.bodies, folder / "bodies.npz")
    _write_evidence(capture, folder)
    write_trees(capture, folder, name)
    if capture.hypotheses:
        own = {piece.id: [piece] for piece in capture.scene.objects}
        for piece in capture.hypotheses:
            own[piece.id].append(piece)
        write_hypotheses(folder, {k: v for k, v in own.items() if len(v) > 1}, {})


def _write_evidence(capture: Capture, folder: Path) -> None:
    """Files that a capture may lack."""
    if capture.touch is not None:
        touch = capture.touch.detach().cpu().numpy()
        write_npz({"probability": touch}, folder / "contacts.npz")
    if not is_still(capture.path):
        write_npz(path_to_arrays(capture.path), folder / "cameras.npz")
    if capture.depth is not None:
        write_depth_image(capture.depth, folder)
    if capture.furniture is not None:
        write_json(furniture_to_json(capture.furniture), folder / FURNITURE)


def write_trees(
    capture: Capture, folder: Path, image: str | None, info: Mapping[str, Any] | None = None
) -> list[str]:
    """Write the JSON files of a capture, and its meshes.

    Args:
        capture: A checked one.
        folder: Where to.
        image: The name of the reference image in the folder.
        info: Further fields of `info` in people.json; None: written only with people.

    Returns:
        The names of the files.
    """
    camera = camera_to_json(capture.scene.camera)
    if capture.camera_height is not None:
        camera["height"] = capture.camera_height
    if capture.focal_spread is not None:
        camera["focal_spread"] = capture.focal_spread
    write_scene(capture.scene, folder / "scene.json")
    objects = detections_to_json(capture.detections, capture.scene.camera, image)
    write_json(objects, folder / "objects.json")
    write_json(camera, folder / "camera.json")
    done = ["camera.json", "scene.json", "objects.json"]
    people, hidden, bodies = capture.people, capture.reference_people, capture.bodies
    if people is None and hidden is None and info is None:
        return done
    frames = [] if bodies is None else bodies.frame.tolist()
    tree = people_to_json(people, hidden, None if bodies is None else bodies.fps, frames)
    write_json({**tree, "info": {**(info or {}), **tree["info"]}}, folder / "people.json")
    return [*done, "people.json"]


def _check_room_for(capture: Capture, folder: Path) -> None:
    """Refuse a folder whose optional files would join a capture that has none."""
    wanted = {
        "bodies.npz": capture.bodies is not None,
        "people.json": capture.people is not None or capture.reference_people is not None,
        "contacts.npz": capture.touch is not None,
        FURNITURE: capture.furniture is not None,
        "cameras.npz": not is_still(capture.path),
        DEPTH: capture.depth is not None and capture.depth.metric,
        DISPARITY: capture.depth is not None and not capture.depth.metric,
    }
    for name, is_written in wanted.items():
        if not is_written and (folder / name).exists():
            raise ValueError(f"{folder} has {name}, which the capture lacks; choose a new folder")
