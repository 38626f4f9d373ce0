"""Capture folders (FORMAT.md): camera, initial scene, annotations, bodies, people."""

import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.core.files import copy_whole
from mover.core.types import Camera, Capture, DepthImage
from mover.geometry.path import is_still
from mover.io.capture.annotations_file import detections_to_json, image_name, people_to_json
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.build import build_capture
from mover.io.capture.camera_file import camera_to_json, path_to_arrays
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.capture.scene_file import HYPOTHESES, write_hypotheses, write_scene
from mover.io.files import images
from mover.io.files.cameras import tilt_fields
from mover.io.files.fields import At, read_json, write_json
from mover.io.files.meshes import read_mesh
from mover.io.files.npz import read_npz, write_npz

REFERENCE, FURNITURE = "reference.jpg", "furniture.json"


def read_capture(folder: Path) -> Capture:
    """Read and check a capture folder; its truth is not looked at."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "there is no such folder"
        raise InputError(f"{folder}: {what}, expected the folder of a capture")
    inner = sorted(path.parent.name for path in folder.glob("*/camera.json"))
    if inner and not (folder / "camera.json").exists():
        raise InputError(f"{folder}: has no camera.json, but captures: {', '.join(inner[:4])}")
    parts = _files(folder, read_json)
    assert parts.objects is not None
    named = image_name(parts.objects)
    if named is None and (folder / REFERENCE).is_file():
        named = At(REFERENCE, "objects.json", "images[0].file_name")
    load = None if named is None else partial(images.read_image, named, folder)
    return build_capture(replace(parts, load_image=load))


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
    named = None if parts.objects is None else image_name(parts.objects)
    first = [named.value] if named is not None and isinstance(named.value, str) else []
    paths = ((folder / name).resolve() for name in (*first, "reference.png", REFERENCE))
    inside = (path for path in paths if path.is_relative_to(folder.resolve()) and path.is_file())
    picture = next(inside, None)
    load, size = (None, None) if picture is None else image_parts(picture)
    depth = images.find_depth_file(folder)
    beside = {} if depth is None else {
        f"{images.DEPTH if depth[1] else images.DISPARITY}/000000{depth[0].suffix.lower()}":
            partial(_put_depth, depth[0])
    }  # fmt: skip
    return replace(
        parts, camera=camera, scene=scene, load_image=load, image_size=size, beside=beside,
        n_frames=None, hypotheses=None, furniture=None,  # they may be of what is replaced
    )  # fmt: skip


def _files(folder: Path, needed: Callable[[Path], At | None]) -> Parts:
    """The files of a folder as they are; `needed` reads those that a capture cannot lack."""

    def load_depth(camera: Camera) -> DepthImage | None:
        if (found := images.find_depth_file(folder)) is None:
            return None
        path, metric = found
        frame = images.reference_frame(folder)
        return DepthImage(images.read_depth(path, camera, metric=metric, frame=frame), metric)

    frames = folder / "frames"
    files = frames.iterdir() if frames.is_dir() else ()
    names = (re.fullmatch(r"([0-9]{6,8})\.(jpg|jpeg|png)", path.name) for path in files)
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
        load_depth=load_depth,
        n_frames=max((int(name[1]) + 1 for name in names if name), default=None),
        hypotheses=_if_there(read_json, folder / HYPOTHESES),
    )


def _put_depth(source: Path, target: Path) -> None:
    """Copy measured depth into a capture, where it is the only one: a picture has one depth."""
    folder = target.parents[1]
    if not source.resolve().is_relative_to(folder.resolve()):
        for name in (images.DEPTH, images.DISPARITY):
            shutil.rmtree(folder / name, ignore_errors=True)
    copy_whole(source, target)


def _if_there(read: Callable[[Path], At], path: Path) -> At | None:
    return read(path) if path.exists() or path.is_symlink() else None


def lacking(capture: Capture) -> set[str]:
    """The files and folders that a capture with all its parts would have, and this one has not."""
    people, depth = capture.people or capture.reference_people, capture.depth
    wanted = {
        "bodies.npz": capture.bodies, "people.json": people, "contacts.npz": capture.touch,
        FURNITURE: capture.furniture, "cameras.npz": None if is_still(capture.path) else True,
        images.DEPTH: depth if depth is not None and depth.metric else None,
        images.DISPARITY: depth if depth is not None and not depth.metric else None,
    }  # fmt: skip
    return {name for name, part in wanted.items() if part is None}


def write_capture(capture: Capture, folder: Path) -> None:
    """Write a capture folder, without frames; reading it gives the same capture.

    The picture is kept with 8 bits a channel.

    Raises:
        ValueError: If the folder has a file that this capture lacks: the two would mix.
    """
    depth = capture.depth
    for name in lacking(capture):
        if (folder / name).exists():
            raise ValueError(f"{folder} has {name}, which the capture lacks; choose a new folder")
    if capture.reference is not None:
        images.write_image(capture.reference, folder / "reference.png")
    if capture.bodies is not None:
        write_bodies(capture.bodies, folder / "bodies.npz")
    if capture.touch is not None:
        touch = capture.touch.detach().cpu().numpy()
        write_npz({"probability": touch}, folder / "contacts.npz")
    if not is_still(capture.path):
        write_npz(path_to_arrays(capture.path), folder / "cameras.npz")
    if depth is not None:
        images.write_depth_image(depth, folder)
    if capture.furniture is not None:
        tree = people_to_json(capture.furniture, None, None, ())
        tree["categories"] = [{"id": 1, "name": "object"}]
        write_json(tree, folder / FURNITURE)
    write_trees(capture, folder, None if capture.reference is None else "reference.png")
    others = {h.id for h in capture.hypotheses}
    groups = {one.id: [one, *(h for h in capture.hypotheses if h.id == one.id)]
              for one in capture.scene.objects if one.id in others}  # fmt: skip
    if groups:
        write_hypotheses(folder, groups)


def write_trees(
    capture: Capture, folder: Path, image: str | None, info: Mapping[str, Any] | None = None
) -> list[str]:
    """Write the JSON files of a capture, and its meshes; the names of the files.

    Args:
        capture: A checked one.
        folder: Where to.
        image: The name of the reference image in the folder.
        info: Further fields of `info` in people.json; None: written only with people.
    """
    camera = camera_to_json(
        capture.scene.camera, height=capture.camera_height, focal_spread=capture.focal_spread,
        focal_by_lines=capture.focal_by_lines,
    )  # fmt: skip
    if capture.tilt is not None:
        camera |= tilt_fields(capture.tilt)
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
