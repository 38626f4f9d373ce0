"""Merge parts of several tools into one capture folder; what is there stays unless given again."""

import dataclasses
import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from mover.core.errors import InputError
from mover.core.files import copy_whole
from mover.core.types import Camera, Capture, Scene
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera, to_world
from mover.geometry.rotations import rot_y
from mover.io.capture.annotations_file import detections_of, people_of
from mover.io.capture.bodies_file import bodies_of, write_bodies
from mover.io.capture.build import build_capture
from mover.io.capture.camera_file import camera_of, turned
from mover.io.capture.folder import folder_parts, read_capture, write_trees
from mover.io.capture.pairing import known_boxes, linked, pair_boxes
from mover.io.capture.parts import UNKNOWN, Parts
from mover.io.capture.scene_file import write_scene
from mover.io.files.fields import At, get, items, maybe, write_json
from mover.io.files.images import DEPTH, DISPARITY, write_image
from mover.io.files.npz import write_npz
from mover.io.masks.coco import annotations_tree

log = logging.getLogger(__name__)

BESIDE = ("copies", "trees", "scenes", "people_of")
SMALL_TURN = 1e-5  # a new rotation of the camera that is the old one


@dataclass(frozen=True)
class Imported:
    """What a folder holds after an import."""

    capture: Capture | None
    """None: something is missing that every capture needs."""
    written: tuple[str, ...]
    """Files that are new."""
    missing: tuple[str, ...]
    """What the capture still lacks, each with its consequence."""
    notes: tuple[str, ...]


NEEDED = {
    "camera": "camera.json: the lens (--camera FILE, or --fov DEGREES with --image)",
    "scene": "scene.json and meshes/: a first guess of the furniture (any of the scene formats)",
}
WISHED = {
    "masks": "object masks in objects.json: only boxes hold the furniture (--objects-masks)",
    "objects": "objects.json: the image holds no furniture (--objects-masks)",
    "bodies": "bodies.npz: no person moves, so the image alone is used (--bodies)",
    "people": "people.json: no depth order from people (--people-masks)",
    "image": "reference.jpg: nothing to draw on (--image)",
}


def import_into(folder: Path, *given: Parts) -> Imported:
    """Add parts to a capture folder; nothing is written unless everything fits.

    Args:
        folder: New, or a capture or a part of one.
        given: What is added, the later before the earlier.

    Raises:
        InputError: If a part is wrong or does not fit the others.
    """
    new = not folder.exists()
    old = Parts(name=folder.resolve().name)
    if not new:
        old = dataclasses.replace(folder_parts(folder), copies={})
    if not new and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a folder for the capture")
    whole, notes = old, list[str]()
    for part in given:
        whole = _added(whole, part)
        notes += part.notes
    whole = _with_size(dataclasses.replace(whole, name=old.name))
    capture = _capture(whole)
    _check_rest(whole, capture)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        written = _write_whole(whole, old, capture, folder)
        if capture is not None:
            capture = read_capture(folder)  # its warnings are those of what was written
    except InputError:  # of a mesh that only its own tool can read
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    return Imported(capture, tuple(written), _missing(whole, capture), tuple(notes))


def _added(old: Parts, new: Parts) -> Parts:
    """The new parts before the old ones; annotations of both are brought together."""
    values = {
        f.name: value
        for f in dataclasses.fields(Parts)
        if f.name not in ("name", "objects", "camera", "notes", "load_mesh", "tilt", *BESIDE)
        and (value := getattr(new, f.name)) is not None
    }
    if new.scene is not None:
        values["load_mesh"] = new.load_mesh
    return dataclasses.replace(
        old,
        **values,
        camera=_camera(old, new),
        tilt=_tilt(old, new),
        objects=_objects(old, new),
        **{name: {**getattr(old, name), **getattr(new, name)} for name in BESIDE},
    )


def _camera(old: Parts, new: Parts) -> At | None:
    """The newer camera, with tilt and height of the older one where it has none."""
    if new.camera is None or old.camera is None:
        return new.camera or old.camera
    kept = {k: v for k in ("R_cam_world", "height") if (v := old.camera.value.get(k)) is not None}
    return At({**kept, **new.camera.value}, new.camera.file, new.camera.field)


def _tilt(old: Parts, new: Parts) -> Any:  # noqa: ANN401
    """R_cam_world of the world in which the scene of both is; None: that of their camera."""
    if new.scene is None:
        own = old.tilt if old.scene is not None else None
        return own or (None if old.camera is None else old.camera.value.get("R_cam_world"))
    camera = new.camera or old.camera
    return new.tilt or (None if camera is None else camera.value.get("R_cam_world"))


def _objects(old: Parts, new: Parts) -> At | None:
    """The annotations of both, under the ids that the scene uses."""
    if new.objects is None or old.objects is None:
        return new.objects or old.objects

    def used(scene: At | None) -> set[int]:
        rows = [] if scene is None else items(get(scene, "objects"))
        return {key.value for row in rows if (key := maybe(row, "annotation")) is not None}

    if new.scene is not None and used(new.scene):
        return _merged(new.objects, old.objects, newer=False, keep=None)
    keep = used(old.scene) if new.scene is None else set[int]()
    return _merged(old.objects, new.objects, newer=True, keep=keep)


def _merged(primary: At, secondary: At, *, newer: bool, keep: set[int] | None) -> At:
    """The annotations of two files of one image as one.

    Args:
        primary: objects.json whose ids the scene names.
        secondary: The other one.
        newer: The second file is the newer one: its boxes and masks win.
        keep: Of the first file, ids to keep although the second has no partner; None: all.
    """
    pairs = pair_boxes(known_boxes(primary), known_boxes(secondary))
    ours, theirs = _named_rows(primary), _named_rows(secondary)
    rows: list[dict[str, Any]] = []
    for i, row in enumerate(ours):
        if i in pairs:
            first, second = (theirs[pairs[i]], row) if newer else (row, theirs[pairs[i]])
            if "segmentation" in second and "segmentation" not in first:
                first, second = second, first  # masks before boxes
            name = row["category_id"]
            name = theirs[pairs[i]]["category_id"] if name == UNKNOWN else name
            rows.append({**second, **first, "id": row["id"], "category_id": name})
        elif keep is None or row["id"] in keep:
            rows.append(row)
    free = max((row["id"] for row in ours), default=-1) + 1
    others = [row for j, row in enumerate(theirs) if j not in set(pairs.values())]
    rows += [{**row, "id": free + k} for k, row in enumerate(others)]
    return At(annotations_tree(rows, items(get(primary, "images"))[0].value), primary.file)


def _named_rows(at: At) -> list[dict[str, Any]]:
    """Annotations with the name of their category instead of its id."""
    names = {c.value["id"]: str(c.value["name"]) for c in items(get(at, "categories"))}
    return [
        {**item.value, "category_id": names[item.value["category_id"]]}
        for item in items(get(at, "annotations"))
    ]


def _with_size(parts: Parts) -> Parts:
    """Without annotations an empty objects.json stands in, so that the scene can be used."""
    if parts.objects is not None or parts.scene is None or parts.camera is None:
        return parts
    size = {"width": parts.camera.value.get("w"), "height": parts.camera.value.get("h")}
    empty = {"images": [{"id": 0, **size}], "categories": [], "annotations": []}
    return dataclasses.replace(parts, objects=At(empty, "objects.json"))


def _capture(whole: Parts) -> Capture | None:
    """The checked capture; None while camera or scene are missing."""
    if whole.camera is None or whole.scene is None or whole.objects is None:
        return None
    camera = whole.camera
    if whole.tilt is not None:  # the objects stand in this world, and move to the camera's below
        camera = At({**camera.value, "R_cam_world": whole.tilt}, camera.file)
    capture = build_capture(dataclasses.replace(whole, camera=camera))
    if whole.tilt is not None:
        wanted, _ = turned(camera_of(whole.camera))
        capture = dataclasses.replace(capture, scene=_under(capture.scene, wanted))
    links = linked(capture.scene, whole.objects)
    objects = tuple(
        dataclasses.replace(p, annotation=links.get(p.id, p.annotation))
        for p in capture.scene.objects
    )
    return dataclasses.replace(capture, scene=dataclasses.replace(capture.scene, objects=objects))


def _under(scene: Scene, camera: Camera) -> Scene:
    """The scene under a new tilt: box centres keep their position in the camera's frame."""
    old, new = scene.camera.R_cam_world.double(), camera.R_cam_world.double()
    if float((old - new).abs().max()) < SMALL_TURN:
        return scene
    pieces: list[Any] = []
    for piece in scene.objects:
        yaw = piece.yaw.double()
        front = torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
        front = to_world(to_camera(front, old), new)
        turn = torch.atan2(front[0], front[2])
        centre = box_of(piece).center.double()
        offset = rot_y(yaw).mT @ (centre - piece.t_world_object.double())
        place = to_world(to_camera(centre, old), new) - rot_y(turn) @ offset
        pieces.append(
            dataclasses.replace(piece, yaw=turn.to(piece.yaw), t_world_object=place.to(piece.scale))
        )
    own = dataclasses.replace(scene.camera, R_cam_world=camera.R_cam_world)
    return Scene(own, None, tuple(pieces))


def _check_rest(whole: Parts, capture: Capture | None) -> None:
    """Check what stands alone while there is no whole capture."""
    if capture is not None:
        return
    ignored: list[str] = []
    if whole.bodies is not None:
        bodies_of(whole.bodies, ignored.append)
    camera = _stand_in(whole)
    if camera is None:
        if whole.people is not None or whole.scene is not None:
            raise InputError(
                f"{whole.name}: has no camera, expected --camera FILE or --fov DEGREES"
            )
        return
    if whole.objects is not None:
        detections_of(whole.objects, camera, ignored.append)
    if whole.people is not None:
        people_of(whole.people, camera, ignored.append)


def _missing(whole: Parts, capture: Capture | None) -> tuple[str, ...]:
    """What is not there, each with its consequence."""
    lacking = [text for key, text in NEEDED.items() if getattr(whole, key) is None]
    objects = None if whole.objects is None else items(get(whole.objects, "annotations"))
    if not objects:
        lacking.append(WISHED["objects"])
    elif not any(maybe(item, "segmentation") for item in objects):
        lacking.append(WISHED["masks"])
    lacking += [WISHED[key] for key in ("bodies", "people") if getattr(whole, key) is None]
    if whole.load_image is None:
        lacking.append(WISHED["image"])
    if capture is not None and capture.bodies is not None and capture.bodies.fps is None:
        lacking.append("the frame rate of the bodies: --fps (without it their speed is not used)")
    return tuple(lacking)


def _stand_in(whole: Parts) -> Camera | None:
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


def _write_whole(whole: Parts, old: Parts, capture: Capture | None, folder: Path) -> list[str]:
    """Write what is new; the names of the files."""
    done: list[str] = []
    name = _write_image(whole, old, capture, folder, done)
    if capture is not None:
        known = None if whole.people is None else whole.people.value.get("info", {})
        done += write_trees(capture, folder, name, known)
    for key in ("camera", "objects", "people") if capture is None else ():
        tree: At | None = getattr(whole, key)
        if tree is not None and tree is not getattr(old, key):
            value: Mapping[str, Any] = tree.value
            if key == "objects" and name is not None:
                value = {**value, "images": [{**value["images"][0], "file_name": name}]}
            write_json(value, folder / f"{key}.json")
            done.append(f"{key}.json")
    if whole.bodies is not None and whole.bodies is not old.bodies:
        bodies = capture.bodies if capture is not None else None
        write_bodies(bodies or bodies_of(whole.bodies, log.info), folder / "bodies.npz")
        done.append("bodies.npz")
    for key in ("contacts", "cameras"):
        arrays: At | None = getattr(whole, key)
        if arrays is not None and arrays is not getattr(old, key):
            write_npz(arrays.value, folder / f"{key}.npz")
            done.append(f"{key}.npz")
    return done + _write_beside(whole, folder)


def _write_beside(whole: Parts, folder: Path) -> list[str]:
    """Frames, keypoints, truth: what stands beside the capture's own files."""
    measured = [place for place in whole.copies if place.split("/")[0] in (DEPTH, DISPARITY)]
    if measured and not whole.copies[measured[0]].is_relative_to(folder):
        for name in (DEPTH, DISPARITY):  # a picture has one depth
            shutil.rmtree(folder / name, ignore_errors=True)
    for place, source in whole.copies.items():
        copy_whole(source, folder / place)
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
    camera = capture.scene.camera if capture is not None else _stand_in(whole)
    if whole.load_image is old.load_image:
        named = None if old.objects is None else old.objects.value["images"][0].get("file_name")
        there = (
            n for n in (named, "reference.png", "reference.jpg") if n and (folder / n).exists()
        )
        return next(there, None)
    if whole.load_image is None or camera is None:
        return None
    picture = whole.load_image(camera) if capture is None else capture.reference
    if picture is None:
        return None
    write_image(picture, folder / "reference.png")
    done.append("reference.png")
    return "reference.png"
