"""What COCO's JSON says: objects.json (the reference image), people.json and furniture.json."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from mover.core.types import Camera, Detection, Masks, People
from mover.geometry.boxes import iou2d
from mover.geometry.rle import area, joined, mask_boxes
from mover.io.files.fields import At, Warn, listed, plain, shown, unique
from mover.io.files.schema import Box, FrameRate, Id, Index, Share, checked
from mover.io.masks import coco

LEAST_OVERLAP = 0.3  # of a box and the box of its mask; below, they are not of one thing


class AnnotationFields(Struct, frozen=True):
    """One of `annotations`; the image, the categories and the masks are COCO's (io/masks)."""

    id: Id
    image_id: Id
    bbox: Box
    score: Share | None = None


def detections_of(at: At, camera: Camera, warn: Warn) -> tuple[Detection, ...]:
    """The instances of objects.json."""
    image = coco.check_image(_only_image(at), camera)
    names = coco.categories_of(at.get("categories"))
    known, found, rows = set[object](), list[Detection](), at.get("annotations")
    if len(rows.items()) > coco.MOST_THINGS:
        rows.refuse(f"at most {coco.MOST_THINGS} of one picture", f"{len(rows.items())} items")
    for item in rows.items():
        row = checked(item, AnnotationFields)
        if row.image_id != image:
            item.get("image_id").refuse(f"{image}, the id of the one image")
        box = _box_of(item.get("bbox"), row.bbox, camera, warn)
        mask = coco.mask_of(item, camera, warn)
        if mask is not None and not area(mask, 0):
            item.get("segmentation").refuse("a mask with pixels", "an empty mask")
        if mask is not None and iou2d(box, mask_boxes(mask)[0]) < LEAST_OVERLAP:
            warn(f"{item.place} has a box and a mask in different places")
        category = coco.category_of(item.get("category_id"), names)
        score = 1.0 if row.score is None else row.score
        found.append(Detection(row.id, category, box, mask, score))
        unique(item.get("id"), known, row.id, "an id")
    if bare := [d.id for d in found if d.mask is None]:
        warn(f"{at.file}: {listed('annotation', bare)} without segmentation, only the box counts")
    return tuple(found)


def image_name(at: At) -> At | None:
    """The field that names the reference image, None if it is not given."""
    return _only_image(at).maybe("file_name")


def _only_image(at: At) -> At:
    """The one image of objects.json."""
    if at.maybe("images") is None and at.maybe("objects") is not None:
        at.refuse("COCO's annotations", "a scene (is it scene.json?)")
    images = at.get("images").items()
    if len(images) > 1:
        rows = at.maybe("annotations")
        if rows and any("track_id" in row.mapping() for row in rows.items()):
            at.refuse("the annotations of one picture", "those of a video (is it people.json?)")
        named = [shown(image.get("file_name").value) for image in images[:3]]
        how = (
            "`mover import masks FILE --image PICTURE --out FOLDER` takes that of a picture's name"
        )
        found = f"{len(images)} images ({', '.join(named)}, ...)"
        at.get("images").refuse(f"a list of 1; {how}", found)
    return at.get("images").items(1)[0]


def _box_of(at: At, box: Box, camera: Camera, warn: Warn) -> Float[Tensor, "4"]:
    """x_min, y_min, x_max, y_max of a COCO box [px]."""
    x, y, w, h = box
    if w <= 0 or h <= 0:
        at.refuse("[x, y, w, h] with w, h above 0")
    if x >= camera.width or y >= camera.height or x + w <= 0 or y + h <= 0:
        at.refuse(f"a box inside the image of {camera.width} x {camera.height}")
    if x < -1 or y < -1 or x + w > camera.width + 1 or y + h > camera.height + 1:
        warn(f"{at.place} reaches beyond the image")
    return torch.tensor([x, y, x + w, y + h])


def detections_to_json(
    detections: tuple[Detection, ...], camera: Camera, file_name: str | None
) -> dict[str, Any]:
    """The content of objects.json."""
    image: dict[str, Any] = {"id": 0, "width": camera.width, "height": camera.height}
    annotations: list[dict[str, Any]] = []
    for d in detections:
        x, y, right, bottom = plain(d.box)
        row = {"id": d.id, "image_id": 0, "category_id": d.category,
               "bbox": [x, y, right - x, bottom - y], "score": d.score}  # fmt: skip
        mask = {} if d.mask is None else {"segmentation": coco.segmentation(d.mask, 0)}
        annotations.append({**row, **mask})
    image |= {} if file_name is None else {"file_name": file_name}
    return coco.annotations_tree(annotations, image, first=1)


# people.json and furniture.json: visible masks of people, and of objects, in the frames.


@dataclass(frozen=True)
class PeopleFile:
    """What people.json says."""

    people: People | None
    reference: Masks | None
    fps: float | None


Height = Annotated[float, Meta(ge=0.3, le=3.0)]
"""Of a person [m]."""


class InfoFields(Struct, frozen=True):
    """`info`: frames a second, and known heights by track."""

    fps: FrameRate | None = None
    heights: dict[str, Height] | None = None


class PersonFields(Struct, frozen=True):
    """One of `annotations`; images, categories and masks are COCO's (io/masks)."""

    image_id: Index
    track_id: Index


def people_of(at: At, camera: Camera, warn: Warn) -> PeopleFile:
    """The people's visible masks in the frames, and in the reference image."""
    info = at.maybe("info")
    known = InfoFields() if info is None else checked(info, InfoFields)
    heights: dict[str, float] = {}
    for key, value in (known.heights or {}).items():
        if not re.fullmatch("[0-9]{1,8}", key):
            field = At(value, at.file, f"info.heights.{key}")
            field.refuse("the number of a track as its name", f"the name {shown(key)}")
        heights[str(int(key))] = value
    frames = set[int]()
    for item in at.get("images").items():
        unique(item.get("id"), frames, coco.check_image(item, camera), "a frame")
    given, behind = at.maybe("categories"), at.maybe("reference_people")
    names = None if given is None else coco.categories_of(given)
    pairs, used = list[tuple[int, int]](), set[object]()
    for item in at.get("annotations").items():
        row = checked(item, PersonFields)
        if row.image_id not in frames:
            item.get("image_id").refuse("the id of one of the images")
        pairs.append((row.image_id, row.track_id))
        unique(item.get("track_id"), used, pairs[-1], "a track of this frame")
    masks = _masks_of(at.get("annotations"), camera, names, warn)
    rows = [(*pair, mask) for pair, mask in zip(pairs, masks, strict=True) if mask is not None]
    if missing := len(pairs) - len(rows):
        warn(f"{at.file}: {missing} of {len(pairs)} people without mask or an empty one")
    people = None
    if rows:
        frame, person = torch.tensor([row[:2] for row in rows]).unbind(1)
        people = People(joined([row[2] for row in rows]), frame, person, heights)
    found = [] if behind is None else _masks_of(behind, camera, names, warn)
    reference = [mask for mask in found if mask is not None]
    if lost := len(found) - len(reference):
        warn(f"{at.file}: {lost} people of the reference image without mask")
    hidden = joined(reference) if reference else None
    return PeopleFile(people, hidden, known.fps)


def _masks_of(
    at: At, camera: Camera, names: dict[int, str] | None, warn: Warn
) -> list[Masks | None]:
    """The visible masks of people; None where one is missing or empty."""
    masks: list[Masks | None] = []
    for item in at.items():
        category, box = item.maybe("category_id"), item.maybe("bbox")
        if category is not None and names is not None:
            coco.category_of(category, names)
        if box is not None:
            checked(box, Box)
        mask = coco.mask_of(item, camera, warn)
        masks.append(mask if mask is not None and area(mask, 0) else None)
    return masks


def furniture_of(
    at: At, camera: Camera, detections: tuple[Detection, ...], warn: Warn
) -> People | None:
    """The objects' visible masks in some frames; tracks are ids of annotations in objects.json."""
    found = people_of(at, camera, warn).people
    known = {detection.id for detection in detections}
    for item in at.get("annotations").items():
        if item.get("track_id").value not in known:
            item.get("track_id").refuse("the id of an annotation in objects.json")
    if found is None:
        warn(f"{at.file}: there are no masks of objects, expected some in its annotations")
    return found


def people_to_json(
    people: People | None, reference: Masks | None, fps: float | None, frames: Iterable[int]
) -> dict[str, Any]:
    """The content of people.json; the frames of bodies are listed even without a mask."""
    info: dict[str, Any] = {} if fps is None else {"fps": fps}
    rows: list[dict[str, Any]] = []
    shown_in = set(frames)
    if people is not None:
        info |= {"heights": people.heights} if people.heights else {}
        shown_in |= set(people.frame.tolist())
        pairs = zip(people.frame.tolist(), people.person.tolist(), strict=True)
        for i, (frame, person) in enumerate(pairs):
            row = {"id": i, "image_id": frame, "category_id": 1, "track_id": person}
            rows.append({**row, "segmentation": coco.segmentation(people.masks, i)})
    tree: dict[str, Any] = {"info": info, "images": [{"id": frame} for frame in sorted(shown_in)]}
    tree |= {"categories": [{"id": 1, "name": "person"}], "annotations": rows}
    if reference is not None:
        hidden = range(len(reference.counts))
        tree["reference_people"] = [
            {"segmentation": coco.segmentation(reference, i)} for i in hidden
        ]
    return tree
