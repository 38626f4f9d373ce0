"""Write the parts of a capture to its folder: only what is new."""

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..records import replacing
from ..types import Camera, Capture
from .bodies_file import bodies_of, write_bodies
from .camera_file import camera_of, camera_to_json
from .fields import At, get, items, maybe, write_json
from .image_file import write_image
from .npz_file import write_npz
from .objects_file import detections_to_json
from .parts import Parts
from .people_file import people_to_json
from .scene_file import write_scene

log = logging.getLogger(__name__)


def stand_in(whole: Parts) -> Camera | None:
    """The camera, or one with the size of the image."""
    if whole.camera is not None:
        return camera_of(whole.camera)
    size = whole.image_size
    for tree in (whole.objects, whole.people):
        for image in [] if tree is None else items(get(tree, "images"))[:1]:
            w, h = maybe(image, "width"), maybe(image, "height")
            if size is None and w is not None and h is not None:
                size = w.value, h.value
    if size is None or whole.scene is not None:
        return None
    fields = {"w": size[0], "h": size[1], "fl_x": 1.0, "fl_y": 1.0, "cx": 0.0, "cy": 0.0}
    return camera_of(At(fields, "image"))


def write_whole(whole: Parts, old: Parts, capture: Capture | None, folder: Path) -> list[str]:
    """Write what is new.

    Args:
        whole: All parts.
        old: Those that were there before.
        capture: The same, checked; None while camera or scene are missing.
        folder: Where to.

    Returns:
        The names of the files.
    """
    done: list[str] = []
    name = _write_image(whole, old, capture, folder, done)
    if capture is not None:
        _write_checked(whole, capture, folder, name, done)
    else:
        _write_loose(whole, old, folder, name, done)
    if whole.bodies is not None and whole.bodies is not old.bodies:
        bodies = capture.bodies if capture is not None else None
        write_bodies(bodies or bodies_of(whole.bodies, log.info), folder / "bodies.npz")
        done.append("bodies.npz")
    if whole.contacts is not None and whole.contacts is not old.contacts:
        write_npz(whole.contacts.value, folder / "contacts.npz")
        done.append("contacts.npz")
    return done + _write_beside(whole, folder)


def _write_beside(whole: Parts, folder: Path) -> list[str]:
    """Frames, keypoints, truth: what stands beside the capture's own files."""
    for place, source in whole.copies.items():
        with replacing(folder / place) as part:
            shutil.copyfile(source, part)
    for place, tree in whole.trees.items():
        write_json(tree, folder / place)
    for place, scene in whole.scenes.items():
        write_scene(scene, folder / place / "scene.json")
    for place, bodies in whole.people_of.items():
        write_bodies(bodies, folder / place / "bodies.npz")
    places = (*whole.copies, *whole.trees, *whole.scenes, *whole.people_of)
    return [f"{name}/" for name in dict.fromkeys(place.split("/")[0] for place in places)]


def _write_image(
    whole: Parts, old: Parts, capture: Capture | None, folder: Path, done: list[str]
) -> str | None:
    """The reference image; its name in the capture."""
    camera = capture.scene.camera if capture is not None else stand_in(whole)
    if whole.load_image is old.load_image:
        named = None if old.objects is None else old.objects.value["images"][0].get("file_name")
        there = (
            n for n in (named, "reference.png", "reference.jpg") if n and (folder / n).exists()
        )
        return next(there, None)
    if whole.load_image is None or camera is None:
        return None
    picture = whole.load_image(camera, log.info) if capture is None else capture.reference
    if picture is None:
        return None
    write_image(picture, folder / "reference.png")
    done.append("reference.png")
    return "reference.png"


def _write_checked(
    whole: Parts, capture: Capture, folder: Path, name: str | None, done: list[str]
) -> None:
    """Camera, scene, annotations and people of a checked capture."""
    camera = camera_to_json(capture.scene.camera)
    if capture.camera_height is not None:
        camera["height"] = capture.camera_height
    if whole.people is not None:
        frames = [] if capture.bodies is None else capture.bodies.frame.tolist()
        fps = None if capture.bodies is None else capture.bodies.fps
        tree = people_to_json(capture.people, capture.reference_people, fps, frames)
        known = whole.people.value.get("info", {})
        write_json({**tree, "info": {**known, **tree["info"]}}, folder / "people.json")
    objects = detections_to_json(capture.detections, capture.scene.camera, name)
    write_scene(capture.scene, folder / "scene.json")
    write_json(objects, folder / "objects.json")
    write_json(camera, folder / "camera.json")
    done += ["camera.json", "scene.json", "objects.json"]
    done += ["people.json"] if whole.people is not None else []


def _write_loose(whole: Parts, old: Parts, folder: Path, name: str | None, done: list[str]) -> None:
    """The parts of a capture that is not whole yet."""
    for key in ("camera", "objects", "people"):
        tree: At | None = getattr(whole, key)
        if tree is not None and tree is not getattr(old, key):
            value: Mapping[str, Any] = tree.value
            if key == "objects" and name is not None:
                value = {**value, "images": [{**value["images"][0], "file_name": name}]}
            write_json(value, folder / f"{key}.json")
            done.append(f"{key}.json")
