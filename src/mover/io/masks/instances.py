"""Instances in images: masks and boxes, on the way to objects.json and people.json."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.rle import area, decode, encode, tight_box
from mover.io.files.fields import At, read_json, refuse
from mover.io.masks.coco import annotations_tree, from_coco, segmentation

PERSON = frozenset({"person", "people", "human", "man", "woman", "child"})
SAME_SHAPE = 0.02  # masks of another size fit an image whose sides have this ratio, nearly


@dataclass(frozen=True)
class Instance:
    """One thing in one image."""

    category: str
    box: tuple[float, ...] | None
    """x_min, y_min, x_max, y_max [px]; None: that of the mask."""
    mask: bytes | None
    """COCO's compressed counts."""
    score: float = 1.0
    frame: int = 0
    track: int | None = None


@dataclass(frozen=True)
class Instances:
    """All things that a source found."""

    items: tuple[Instance, ...]
    size: tuple[int, int] | None
    """Width and height of the images [px]; None where the source has none."""
    file: str


def mask_code(at: At) -> dict[str, Any]:
    """The run-length code of rows of booleans, as MOVER's detections.json holds them."""
    try:
        pixels = np.asarray(at.value)
    except ValueError:
        return refuse(at, "rows of booleans of one length")
    if pixels.ndim != 2 or pixels.dtype.kind not in "bui" or not pixels.size:
        refuse(at, "rows of booleans of one length")
    return {"size": list(pixels.shape), "counts": encode(torch.from_numpy(pixels != 0)).decode()}


def code_of(pixels: NDArray[Any]) -> bytes | None:
    """The run-length code of an image of booleans; None where it is empty."""
    return encode(torch.from_numpy(np.ascontiguousarray(pixels))) if pixels.any() else None


def checked_code(given: Any, size: tuple[int, int], at: At) -> bytes | None:  # noqa: ANN401
    """The code of COCO's polygons or run lengths in an image of this size; None where empty."""
    width, height = size
    code = from_coco(given, height, width, at.place)
    return code if area(Masks(height, width, (code,)), 0) else None


def fitted(found: Instances, size: tuple[int, int] | None) -> Instances:
    """The instances in an image of this size, resampled where theirs has the same shape."""
    if size is None or found.size is None or found.size == size:
        return found if found.size is not None else dataclasses.replace(found, size=size)
    (w, h), (width, height) = found.size, size
    if abs(w * height / (h * width) - 1) > SAME_SHAPE:
        at = f"{found.file}: masks of {w} x {h} pixels"
        raise InputError(f"{at}, expected those of an image of {width} x {height}")
    rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64).clip(0, h - 1)
    columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64).clip(0, w - 1)
    items: list[Instance] = []
    for item in found.items:
        box, mask = item.box, item.mask
        if box is not None:
            box = tuple(v * (width / w, height / h)[i % 2] for i, v in enumerate(box))
        if mask is not None:
            mask = code_of(decode(Masks(h, w, (mask,)), 0).numpy()[rows][:, columns])
        items.append(dataclasses.replace(item, box=box, mask=mask))
    return Instances(tuple(items), size, found.file)


def is_person(item: Instance) -> bool:
    """Whether an instance is a person."""
    return item.category.lower() in PERSON


def objects_tree(found: Instances, items: Sequence[Instance]) -> At:
    """The fields of objects.json; ids are the ranks in `items`.

    Raises:
        InputError: If the size of the image is not known.
    """
    width, height = _size_of(found, "image")
    names = list(dict.fromkeys(item.category for item in items))
    rows: list[dict[str, Any]] = []
    for i, item in enumerate(items):
        row: dict[str, Any] = {"id": i, "image_id": 0, "category_id": item.category}
        box = item.box
        if item.mask is not None:
            mask = Masks(height, width, (item.mask,))
            row["segmentation"] = segmentation(mask, 0)
            box = tuple(float(v) for v in tight_box(decode(mask, 0)))
        if box is None or box[2] <= box[0] or box[3] <= box[1]:
            continue  # empty: there is nothing of it in the image
        x, y, right, bottom = box
        rows.append({**row, "bbox": [x, y, right - x, bottom - y], "score": item.score})
    image = {"id": 0, "width": width, "height": height}
    return At(annotations_tree(rows, image, names), found.file)


def people_tree(found: Instances, fps: float | None = None) -> At:
    """The fields of people.json: everything in `found` is a person.

    Raises:
        InputError: If the size of the images is not known.
    """
    width, height = _size_of(found, "images")
    rows: list[dict[str, Any]] = []
    for item in followed(found.items):
        row = {"id": len(rows), "image_id": item.frame, "track_id": item.track, "category_id": 1}
        if item.mask is not None:
            mask = segmentation(Masks(height, width, (item.mask,)), 0)
            rows.append({**row, "segmentation": mask})
    frames = sorted({item.frame for item in found.items})
    tree = {
        "info": {} if fps is None else {"fps": fps},
        "images": [{"id": f, "width": width, "height": height} for f in frames],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": rows,
    }
    return At(tree, found.file)


def _size_of(found: Instances, what: str) -> tuple[int, int]:
    """Width and height [px]."""
    if found.size is None:
        raise InputError(f"{found.file}: has no size of the {what}, expected --image beside it")
    return found.size


def followed(items: Sequence[Instance]) -> list[Instance]:
    """Instances with a track each: those without one are numbered by score in their frame."""
    frames: dict[int, list[Instance]] = {}
    for item in items:
        frames.setdefault(item.frame, []).append(item)
    found: list[Instance] = []
    for frame in sorted(frames):
        used = {item.track for item in frames[frame]}
        free = (n for n in range(len(frames[frame]) + len(used)) if n not in used)
        seen: set[int | None] = set()
        for item in sorted(frames[frame], key=lambda i: -i.score):
            if item.track is None:
                item = dataclasses.replace(item, track=next(free))
            if item.track not in seen:
                found.append(item)
            seen.add(item.track)
    return found


def with_reference_people(people: At | None, found: Instances, folder: Path) -> At:
    """people.json with these masks as the people of the reference image.

    Args:
        people: The fields that are to be written; None: those of the folder, or none.
        found: Their masks.
        folder: The capture.
    """
    if people is None and (folder / "people.json").exists():
        people = read_json(folder / "people.json")
    empty = {"images": [], "annotations": [], "categories": [{"id": 1, "name": "person"}]}
    tree: dict[str, Any] = dict(empty if people is None else people.value)
    width, height = found.size or (0, 0)
    tree["reference_people"] = [
        {"segmentation": segmentation(Masks(height, width, (item.mask,)), 0)}
        for item in found.items
        if item.mask is not None
    ]
    return At(tree, found.file)
