"""people.json: people's visible masks in the frames."""

import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from typing import Any

import torch

from ..types import Camera, Masks, People
from .coco import categories_of, category_of, check_image, mask_of, segmentation
from .fields import (
    At,
    Warn,
    get,
    integer,
    items,
    mapping,
    maybe,
    number,
    positive,
    refuse,
    shown,
    unique,
    vector,
)
from .masks import area, joined

HEIGHTS = 0.3, 3.0  # [m], shortest and tallest


@dataclass(frozen=True)
class PeopleFile:
    """What people.json says."""

    people: People | None
    reference: Masks | None
    fps: float | None
    frames: frozenset[int]
    """Frames that were looked at, with people or without."""


def people_of(at: At, camera: Camera, warn: Warn) -> PeopleFile:
    """The people's visible masks in the frames, and in the reference image.

    Raises:
        InputError: If a field is wrong.
    """
    fps, heights = _info(maybe(at, "info"))
    frames: dict[int, None] = {}
    for item in items(get(at, "images")):
        frame = check_image(item, camera)
        if frame in frames:
            refuse(get(item, "id"), "a frame that is not used twice")
        frames[frame] = None
    known = maybe(at, "categories")
    names = None if known is None else categories_of(known)
    rows, masks = _rows_of(get(at, "annotations"), frames, camera, names, warn)
    people = None
    if masks:
        frame, person = torch.tensor(rows).unbind(1)
        people = People(joined(masks), frame, person, heights)
    return PeopleFile(people, _reference(at, camera, names, warn), fps, frozenset(frames))


def _rows_of(
    at: At, frames: Container[int], camera: Camera, names: dict[int, str] | None, warn: Warn
) -> tuple[list[tuple[int, int]], list[Masks]]:
    """Frame, track and mask of each annotation that has one."""
    rows: list[tuple[int, int]] = []
    masks: list[Masks] = []
    seen: set[object] = set()
    for item in items(at):
        frame, person = integer(get(item, "image_id")), integer(get(item, "track_id"))
        if frame not in frames:
            refuse(get(item, "image_id"), "the id of one of the images")
        unique(get(item, "track_id"), seen, (frame, person), "a track of this frame")
        mask = _person_mask(item, camera, names, warn)
        if mask is not None:
            rows.append((frame, person))
            masks.append(mask)
    if len(rows) < len(seen):
        warn(
            f"{at.file}: {len(seen) - len(rows)} of {len(seen)} people without mask or an empty one"
        )
    return rows, masks


def _info(at: At | None) -> tuple[float | None, dict[str, float]]:
    """Frames a second, and known heights by track [m]."""
    if at is None:
        return None, {}
    fps, heights = maybe(at, "fps"), maybe(at, "heights")
    known: dict[str, float] = {}
    if heights is not None:
        for key in mapping(heights):
            field = get(heights, key)
            if not re.fullmatch("[0-9]{1,8}", key):
                refuse(field, "the number of a track as its name", f"the name {shown(key)}")
            known[str(int(key))] = number(field, *HEIGHTS)
    return None if fps is None else positive(fps), known


def _person_mask(at: At, camera: Camera, names: dict[int, str] | None, warn: Warn) -> Masks | None:
    """The visible mask of a person; None where it is missing or empty."""
    category, box = maybe(at, "category_id"), maybe(at, "bbox")
    if category is not None and names is not None:
        category_of(category, names)
    if box is not None:
        vector(box, 4)
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
