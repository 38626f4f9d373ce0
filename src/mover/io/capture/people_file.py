"""people.json and furniture.json: visible masks of people, and of objects, in the frames."""

import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from msgspec import Meta, Struct

from mover.core.types import Camera, Detection, Masks, People
from mover.geometry.rle import area, joined
from mover.io.files.fields import At, Warn, get, items, maybe, refuse, shown, unique
from mover.io.files.schema import Box, FrameRate, Index, checked
from mover.io.masks.coco import categories_of, category_of, check_image, mask_of, segmentation


@dataclass(frozen=True)
class PeopleFile:
    """What people.json says."""

    people: People | None
    reference: Masks | None
    fps: float | None
    frames: frozenset[int]
    """Frames that were looked at, with people or without."""


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
    """The people's visible masks in the frames, and in the reference image.

    Raises:
        InputError: If a field is wrong.
    """
    info = maybe(at, "info")
    known = InfoFields() if info is None else checked(info, InfoFields)
    heights: dict[str, float] = {}
    for key, value in (known.heights or {}).items():
        if not re.fullmatch("[0-9]{1,8}", key):
            field = At(value, at.file, f"info.heights.{key}")
            refuse(field, "the number of a track as its name", f"the name {shown(key)}")
        heights[str(int(key))] = value
    frames: dict[int, None] = {}
    for item in items(get(at, "images")):
        frame = check_image(item, camera)
        if frame in frames:
            refuse(get(item, "id"), "a frame that is not used twice")
        frames[frame] = None
    given = maybe(at, "categories")
    names = None if given is None else categories_of(given)
    rows, masks = _rows_of(get(at, "annotations"), frames, camera, names, warn)
    people = None
    if masks:
        frame, person = torch.tensor(rows).unbind(1)
        people = People(joined(masks), frame, person, heights)
    return PeopleFile(people, _reference(at, camera, names, warn), known.fps, frozenset(frames))


def _rows_of(
    at: At, frames: Container[int], camera: Camera, names: dict[int, str] | None, warn: Warn
) -> tuple[list[tuple[int, int]], list[Masks]]:
    """Frame, track and mask of each annotation that has one."""
    rows: list[tuple[int, int]] = []
    masks: list[Masks] = []
    seen: set[object] = set()
    for item in items(at):
        row = checked(item, PersonFields)
        if row.image_id not in frames:
            refuse(get(item, "image_id"), "the id of one of the images")
        pair = row.image_id, row.track_id
        unique(get(item, "track_id"), seen, pair, "a track of this frame")
        mask = _person_mask(item, camera, names, warn)
        if mask is not None:
            rows.append(pair)
            masks.append(mask)
    if missing := len(seen) - len(rows):
        warn(f"{at.file}: {missing} of {len(seen)} people without mask or an empty one")
    return rows, masks


def _person_mask(at: At, camera: Camera, names: dict[int, str] | None, warn: Warn) -> Masks | None:
    """The visible mask of a person; None where it is missing or empty."""
    category, box = maybe(at, "category_id"), maybe(at, "bbox")
    if category is not None and names is not None:
        category_of(category, names)
    if box is not None:
        checked(box, Box)
    mask = mask_of(at, camera, warn)
    return mask if mask is not None and area(mask, 0) else None


def _reference(at: At, camera: Camera, names: dict[int, str] | None, warn: Warn) -> Masks | None:
    """People in the reference image."""
    given = maybe(at, "reference_people")
    found = [] if given is None else [_person_mask(i, camera, names, warn) for i in items(given)]
    masks = [mask for mask in found if mask is not None]
    if len(masks) < len(found):
        warn(f"{at.file}: {len(found) - len(masks)} people of the reference image without mask")
    return joined(masks) if masks else None


def furniture_of(
    at: At, camera: Camera, detections: tuple[Detection, ...], warn: Warn
) -> People | None:
    """The objects' visible masks in some frames; tracks are numbers of annotations.

    Raises:
        InputError: If a field is wrong, or a track is no annotation of objects.json.
    """
    found = people_of(at, camera, warn).people
    known = {detection.id for detection in detections}
    for index, item in enumerate(items(get(at, "annotations"))):
        if get(item, "track_id").value not in known:
            field = At(get(item, "track_id").value, at.file, f"annotations[{index}].track_id")
            refuse(field, "the id of an annotation in objects.json")
    if found is None:
        warn(f"{at.file}: there are no masks of objects, expected some in its annotations")
    return found


def furniture_to_json(furniture: People) -> dict[str, Any]:
    """The content of furniture.json."""
    tree = people_to_json(furniture, None, None, ())
    return {**tree, "categories": [{"id": 1, "name": "object"}]}


def people_to_json(
    people: People | None, reference: Masks | None, fps: float | None, frames: Iterable[int]
) -> dict[str, Any]:
    """The content of people.json.

    Args:
        people: Visible masks in the frames.
        reference: People in the reference image.
        fps: Frames a second.
        frames: Frames of bodies, listed even where they have no mask.
    """
    info: dict[str, Any] = {} if fps is None else {"fps": fps}
    rows: list[dict[str, Any]] = []
    shown_in = set(frames)
    if people is not None:
        info |= {"heights": people.heights} if people.heights else {}
        shown_in |= set(people.frame.tolist())
        pairs = zip(people.frame.tolist(), people.person.tolist(), strict=True)
        for i, (frame, person) in enumerate(pairs):
            row = {"id": i, "image_id": frame, "category_id": 1, "track_id": person}
            rows.append({**row, "segmentation": segmentation(people.masks, i)})
    tree: dict[str, Any] = {"info": info, "images": [{"id": frame} for frame in sorted(shown_in)]}
    tree |= {"categories": [{"id": 1, "name": "person"}], "annotations": rows}
    if reference is not None:
        hidden = range(len(reference.counts))
        tree["reference_people"] = [{"segmentation": segmentation(reference, i)} for i in hidden]
    return tree
