"""Merge parts of several tools into one capture folder; what is there stays unless given again."""

import dataclasses
import functools
import logging
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.core.errors import InputError
from mover.core.records import fingerprint, rows_of
from mover.core.types import Bodies, Camera, Capture, Masks, Scene
from mover.furniture.library import canonical
from mover.io.capture import agreement as agree
from mover.io.capture.annotations_file import detections_of, people_of
from mover.io.capture.bodies_file import bodies_of, bodies_to_arrays, write_bodies
from mover.io.capture.camera_file import camera_of, measured_tilt, turned
from mover.io.capture.edits import carried, facing
from mover.io.capture.folder import (
    REFERENCE,
    build_capture,
    folder_parts,
    read_capture,
    write_trees,
)
from mover.io.capture.parts import UNKNOWN, Parts
from mover.io.capture.pose_file import joined_bodies
from mover.io.capture.tracks import numbers_beside, renumbered
from mover.io.files.fields import At, listed, write_json, write_npz
from mover.io.files.images import write_image
from mover.io.masks.coco import annotations_tree

log = logging.getLogger(__name__)

MOST = 0.5  # share of masks that must be of things, not of what is around them
SMALL_TURN = 1e-5  # a new rotation of the camera that is the old one
LEAST = 0.1  # boxes of one class that share less are not of one thing
OTHER_CLASS = 0.5  # the same, of different classes
Rows = Sequence[Mapping[str, Any]]
"""Annotations of objects.json with the names of their categories as `category_id`."""


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


def import_into(folder: Path, *given: Parts) -> Imported:
    """Add parts to a capture folder; nothing is written unless everything fits.

    Args:
        folder: New, or a capture or a part of one.
        given: What is added, the later before the earlier.

    Raises:
        InputError: If a part is wrong or does not fit the others.
    """
    new = not folder.exists()
    if not new and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a folder for the capture")
    old = Parts(folder.resolve().name) if new else replace(folder_parts(folder), beside={})
    whole = functools.reduce(with_parts, given, old)
    if whole.objects is None and whole.scene is not None and whole.camera is not None:
        size = {"width": whole.camera.value.get("w"), "height": whole.camera.value.get("h")}
        empty = {"images": [{"id": 0, **size}], "categories": [], "annotations": []}
        whole = replace(whole, objects=At(empty, "objects.json"))  # so the scene can be used
    capture = _capture(whole)
    if capture is None:
        whole = replace(whole, notes=(*whole.notes, *_check_apart(whole)))
    folder.mkdir(parents=True, exist_ok=True)
    try:
        written = _write(whole, old, capture, folder)
        if capture is not None:
            capture = read_capture(folder)  # its warnings are those of what was written
    except InputError:  # of a mesh that only its own tool can read
        if new:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    return Imported(capture, tuple(written), _missing(whole), whole.notes)


def with_parts(old: Parts, new: Parts) -> Parts:
    """The new parts before the old ones; annotations and bodies of both are brought together.

    The newer camera has the tilt and the height of the older one where it has none. The tilt is
    that of the world in which the scene of both is.
    """
    values = {f.name: value for f in dataclasses.fields(Parts)
              if (value := getattr(new, f.name)) is not None}  # fmt: skip
    camera = new.camera or old.camera
    if new.camera is not None and old.camera is not None:
        tilt = () if "R_cam_world" in new.camera.value else ("R_cam_world", "tilt_spread")
        kept = {k: v for k in (*tilt, "height")
                if (v := old.camera.value.get(k)) is not None}  # fmt: skip
        camera = At({**kept, **new.camera.value}, new.camera.file, new.camera.field)
    scene, lens = (old, old.camera) if new.scene is None else (new, new.camera or old.camera)
    tilt = None if scene.scene is None else scene.tilt
    bodies, notes = _bodies(old.bodies, new.bodies)
    values |= {
        "name": old.name, "camera": camera, "objects": _objects(old, new), "bodies": bodies,
        "tilt": tilt or (None if lens is None else lens.value.get("R_cam_world")),
        "load_mesh": scene.load_mesh, "notes": (*old.notes, *new.notes, *notes),
        "beside": {**old.beside, **new.beside},
    }  # fmt: skip
    return replace(old, **values)


def _bodies(old: At | None, new: At | None) -> tuple[At | None, tuple[str, ...]]:
    """The bodies of both files, those of the newer where both have a person, and what is said."""
    if old is None or new is None or new is old:
        return new or old, ()
    first, second = (bodies_of(at, lambda _: None) for at in (old, new))
    if fingerprint(first) == fingerprint(second):
        return old, ()
    if first.space != second.space:
        new.get("space").refuse(f"{first.space!r}, as the bodies that are there")
    numbers, same = numbers_beside(first, second)
    second = replace(second, person=renumbered(second.person, numbers))
    notes = [f"{new.file}: its person {a} is person {b} here" for a, b in numbers.items() if a != b]
    if again := sorted(same):
        notes.append(f"{new.file}: replaces {listed('track', again)} of the same people")
    if added := sorted({*second.person.tolist()} - same):
        notes.append(f"{new.file}: adds {listed('track', added)} to bodies.npz")
    whole = _united(first, second, same, new.file)
    if whole.pose is None and (first.pose is not None or second.pose is not None):
        notes.append("bodies.npz: parameters of two kinds, so that the meshes alone are kept")
    if None not in (first.fps, second.fps) and first.fps != second.fps:
        notes.append(f"bodies.npz: frame rates {first.fps:g} and {second.fps:g}; the newer counts")
    return At(bodies_to_arrays(whole), new.file), tuple(notes)


def _united(first: Bodies, second: Bodies, same: set[int], file: str) -> Bodies:
    """The rows of both in the order of frames, without those of the first that are given again."""
    kept = torch.ones(len(first.frame), dtype=torch.bool)
    for one in same:
        frame = second.frame[second.person == one]
        kept &= (first.person != one) | (first.frame < frame.min()) | (first.frame > frame.max())
    if not kept.any():
        return second
    counts = [one.verts.shape[1] for one in (first, second)]
    if counts[0] != counts[1] or not torch.equal(first.faces, second.faces):
        raise InputError(
            f"{file}: has bodies of {counts[1]} vertices, those in the capture {counts[0]}, "
            "expected one topology (remove its bodies.npz to put these in its place)"
        )
    whole = joined_bodies([rows_of(first, kept), second])
    whole = replace(whole, fps=first.fps if second.fps is None else second.fps)
    return rows_of(whole, torch.from_numpy(np.lexsort((whole.person, whole.frame))))


def _objects(old: Parts, new: Parts) -> At | None:
    """The annotations of both, under the ids that the scene uses.

    Of two that show one thing, boxes and masks of the newer count, but masks before boxes.
    """
    if new.objects is None or old.objects is None:
        return new.objects or old.objects

    def used(scene: At | None) -> set[int]:
        rows = [] if scene is None else scene.get("objects").items()
        return {key.value for row in rows if (key := row.maybe("annotation")) is not None}

    newer = new.scene is None or not used(new.scene)  # the ids are those of the older file
    first, second = (old.objects, new.objects) if newer else (new.objects, old.objects)
    keep = used(old.scene) if new.scene is None else set[int]()  # although without a partner
    ours, theirs = named_rows(first), named_rows(second)
    pairs = pair_rows(ours, theirs)
    rows: list[dict[str, Any]] = []
    for i, row in enumerate(ours):
        if i in pairs:
            other = theirs[pairs[i]]
            best, rest = (other, row) if newer else (row, other)
            if "segmentation" in rest and "segmentation" not in best:
                best, rest = rest, best
            name = row["category_id"]
            name = other["category_id"] if name == UNKNOWN else name
            rows.append({**rest, **best, "id": row["id"], "category_id": name})
        elif not newer or row["id"] in keep:
            rows.append(row)
    free = max((row["id"] for row in ours), default=-1) + 1
    others = [row for j, row in enumerate(theirs) if j not in set(pairs.values())]
    rows += [{**row, "id": free + k} for k, row in enumerate(others)]
    return At(annotations_tree(rows, first.get("images").items()[0].value), first.file)


def named_rows(at: At) -> list[dict[str, Any]]:
    """The annotations of objects.json with the names of their categories instead of ids."""
    names = {c.value["id"]: str(c.value["name"]) for c in at.get("categories").items()}
    return [
        {**item.value, "category_id": names[item.value["category_id"]]}
        for item in at.get("annotations").items()
    ]


def pair_rows(ours: Rows, theirs: Rows) -> dict[int, int]:
    """Rows (`category_id`, `bbox`) that show one thing: those with the greatest sum of overlaps.

    Returns:
        Index in `theirs` by index in `ours`.
    """
    if not ours or not theirs:
        return {}
    boxes = [np.array([row["bbox"] for row in side], dtype=np.float64) for side in (ours, theirs)]
    a, b = (torch.from_numpy(box + np.pad(box[:, :2], ((0, 0), (2, 0)))) for box in boxes)
    shared = agree.pairwise_iou2d(a, b).numpy()
    names, others = ([row["category_id"] for row in side] for side in (ours, theirs))
    same = np.array([[UNKNOWN in (x, y) or canonical(x) == canonical(y) for y in others]
                     for x in names])  # fmt: skip
    gain = np.where(shared >= np.where(same, LEAST, OTHER_CLASS), shared + same, 0.0)
    return dict(agree.assigned(torch.from_numpy(gain), LEAST))


def linked(scene: Scene, at: At) -> dict[str, int]:
    """Annotation of each object that has none yet, by the objects' outlines in the image.

    Returns:
        Annotation id by object id, for those that find one.
    """
    used = {p.annotation for p in scene.objects}
    free = [row for row in named_rows(at) if row["id"] not in used]
    bare: list[dict[str, Any]] = []
    pieces = [agree.outermost(piece) for piece in scene.objects if piece.annotation is None]
    boxes = agree.in_image(agree.outlines(pieces, scene.camera), scene.camera).tolist()
    for piece, (x, y, right, bottom) in zip(pieces, boxes, strict=True):
        if x < right and y < bottom:
            size = [x, y, right - x, bottom - y]
            bare.append({"id": piece.id, "category_id": piece.category, "bbox": size})
    return {bare[i]["id"]: free[j]["id"] for i, j in pair_rows(bare, free).items()}


def _capture(whole: Parts) -> Capture | None:
    """The checked capture; None while camera or scene are missing."""
    if whole.camera is None or whole.scene is None or whole.objects is None:
        return None
    camera = whole.camera
    if whole.tilt is not None:  # the objects stand in this world, and move to the camera's below
        camera = At({**camera.value, "R_cam_world": whole.tilt}, camera.file)
    capture = build_capture(replace(whole, camera=camera))
    scene = capture.scene
    if whole.tilt is not None:
        old, new = scene.camera.R_cam_world, turned(camera_of(whole.camera))[0].R_cam_world
        if float((old - new).abs().max()) >= SMALL_TURN:
            objects = tuple(carried(o, old @ facing(o.yaw), old, new) for o in scene.objects)
            scene = Scene(replace(scene.camera, R_cam_world=new), None, objects)
    links = linked(scene, whole.objects)
    objects = (replace(p, annotation=links.get(p.id, p.annotation)) for p in scene.objects)
    tilt = measured_tilt(whole.camera)
    return replace(capture, scene=replace(scene, objects=tuple(objects)), tilt=tilt)


def _check_apart(whole: Parts) -> Iterator[str]:
    """Check each part by itself while there is no whole capture; what is odd."""
    ignored: list[str] = []
    if whole.bodies is not None:
        bodies_of(whole.bodies, ignored.append)
    camera = _camera_of(whole)
    if camera is None and (whole.people is not None or whole.scene is not None):
        raise InputError(f"{whole.name}: has no camera, expected --camera FILE or --fov DEGREES")
    groups: list[tuple[str, str, Masks]] = []  # file, name, masks of one
    if camera is not None and whole.objects is not None:
        found = detections_of(whole.objects, camera, ignored.append)
        file = whole.objects.file
        groups += [(file, f"{d.category} ({d.id})", d.mask) for d in found if d.mask is not None]
    if camera is not None and whole.people is not None:
        people = people_of(whole.people, camera, ignored.append).people
        if people is not None:
            for track in people.person.unique().tolist():
                few = rows_of(people, people.person == track).masks
                groups.append((whole.people.file, f"person {track}", few))
    for file in dict.fromkeys(file for file, *_ in groups):
        masks = {name: masks for other, name, masks in groups if other == file}
        odd = [name for name, of_one in masks.items() if agree.bounded([of_one]).mean() < MOST]
        if odd:
            yield f"{file}: masks fill the picture to its borders, inverted? {', '.join(odd[:9])}"


def _camera_of(whole: Parts) -> Camera | None:
    """The camera, or one with the size of the image."""
    if whole.camera is not None:
        return camera_of(whole.camera)
    size = whole.image_size
    for tree in (whole.objects, whole.people):
        for image in [] if tree is None else tree.get("images").items()[:1]:
            w, h = image.maybe("width"), image.maybe("height")
            if size is None and w is not None and h is not None:
                size = w.value, h.value
    if size is None or whole.scene is not None:
        return None
    fields = {"w": size[0], "h": size[1], "fl_x": 1.0, "fl_y": 1.0, "cx": 0.0, "cy": 0.0}
    return camera_of(At(fields, "image"))


def _missing(whole: Parts) -> tuple[str, ...]:
    """What is not there, each with its consequence."""
    rows = [] if whole.objects is None else whole.objects.get("annotations").items()
    masked = any(row.maybe("segmentation") for row in rows)
    lacking = {
        "camera.json: the lens (--camera FILE, or --fov DEGREES with --image)": not whole.camera,
        "scene.json and meshes/: a first guess of the furniture (any of the scene formats)":
            not whole.scene,
        "objects.json: the image holds no furniture (--objects-masks)": not rows,
        "object masks in objects.json: only boxes hold the furniture (--objects-masks)":
            rows and not masked,
        "bodies.npz: no person moves, so the image alone is used (--bodies)": not whole.bodies,
        "people.json: no depth order from people (--people-masks)": not whole.people,
        "reference.jpg: nothing to draw on (--image)": not whole.load_image,
    }  # fmt: skip
    return tuple(text for text, is_missing in lacking.items() if is_missing)


def _write(whole: Parts, old: Parts, capture: Capture | None, folder: Path) -> list[str]:
    """Write what is new; the names of the files."""
    name, done = _write_image(whole, old, capture, folder)
    if capture is not None:
        info = None if whole.people is None else whole.people.value.get("info", {})
        done += write_trees(capture, folder, name, info)

    trees = ("camera", "objects", "people") if capture is None else ()
    for key in (*trees, "bodies", "contacts", "cameras"):
        at: At | None = getattr(whole, key)
        if at is None or at is getattr(old, key):
            continue
        value: Any = at.value
        file = folder / f"{key}.{'json' if key in trees else 'npz'}"
        if key == "objects" and name is not None:
            value = {**value, "images": [{**value["images"][0], "file_name": name}]}
        if key == "bodies":
            bodies = None if capture is None else capture.bodies
            write_bodies(bodies or bodies_of(at, log.info), file)
        elif key in trees:
            write_json(value, file)
        else:
            write_npz(value, file)
        done.append(file.name)
    for place, write in whole.beside.items():
        write(folder / place)
    return done + [f"{n}/" for n in dict.fromkeys(place.split("/")[0] for place in whole.beside)]


def _write_image(
    whole: Parts, old: Parts, capture: Capture | None, folder: Path
) -> tuple[str | None, list[str]]:
    """The name of the reference image, and that of the file if it is new."""
    if whole.load_image is old.load_image:
        named = None if old.objects is None else old.objects.value["images"][0].get("file_name")
        names = (n for n in (named, "reference.png", REFERENCE) if n and (folder / n).exists())
        return next(names, None), []
    camera = capture.scene.camera if capture is not None else _camera_of(whole)
    if whole.load_image is None or camera is None:
        return None, []
    known = None if capture is None else capture.reference
    picture = whole.load_image(camera) if known is None else known
    write_image(picture, folder / "reference.png")
    return "reference.png", ["reference.png"]
