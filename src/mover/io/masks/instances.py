"""Instances in images: masks and boxes, on the way to objects.json and people.json.

labelme's JSON has polygons, rectangles, circles, and the masks of its AI tools.
"""

import base64
import dataclasses
import io
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from msgspec import Struct
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.furniture.library import plain_name, unknown_names
from mover.geometry.rle import area, encode, mask_boxes, resampled
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import LAST_INDEX, At, listed, read_json
from mover.io.files.schema import Side, Text, checked
from mover.io.masks.coco import annotations_tree, from_coco, is_drawn, segmentation
from mover.io.people import found as bodies

PERSON = frozenset({
    "person", "persons", "people", "human", "humans", "man", "men", "woman", "women", "child",
    "children", "boy", "girl", "adult", "pedestrian", "actor", "player", "human body", "kid",
})  # fmt: skip
SAME_SHAPE = 0.02  # masks of another size fit an image whose sides have this ratio, nearly
Size = tuple[int, int]
"""Width and height of an image [px]."""
Names = Mapping[str, str]
"""Categories where the source has none: by number, file name or index."""


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

    @property
    def is_person(self) -> bool:
        """Whether it is a person."""
        return self.category.lower() in PERSON or plain_name(self.category) in PERSON


@dataclass(frozen=True)
class Instances:
    """All things that a source found."""

    items: tuple[Instance, ...]
    size: Size | None
    """Width and height of the images [px]; None where the source has none."""
    file: str
    frames: frozenset[int] = frozenset()
    """Those that were looked at, with things in them or without."""
    notes: tuple[str, ...] = ()
    """What was decided that the source does not say."""
    fps: float | None = None
    """Frames a second, where the source has a rate."""

    def fitted(self, size: Size | None) -> "Instances":
        """The instances in an image of this size, resampled where theirs has the same shape."""
        if size is None or self.size is None or self.size == size:
            return self if self.size is not None else dataclasses.replace(self, size=size)
        (w, h), (width, height) = self.size, size
        if abs(w * height / (h * width) - 1) > SAME_SHAPE:
            at = f"{self.file}: masks of {w} x {h} pixels"
            cure = "make them of it (`mover video --objects`: of OUT/capture/reference.png)"
            raise InputError(f"{at}, expected those of an image of {width} x {height}: {cure}")
        rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64).clip(0, h - 1)
        columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64).clip(0, w - 1)
        items: list[Instance] = []
        for item in self.items:
            box, mask = item.box, item.mask
            if box is not None:
                box = tuple(v * (width / w, height / h)[i % 2] for i, v in enumerate(box))
            if mask is not None:
                mask = resampled(Masks(h, w, (mask,)), 0, rows, columns)
            items.append(dataclasses.replace(item, box=box, mask=mask))
        said = f"masks of {w} x {h} pixels are stretched to the image of {width} x {height}"
        return dataclasses.replace(self, items=tuple(items), size=size, notes=(*self.notes, said))

    def people(self) -> "Instances":
        """The people among the instances, and such as have no name.

        Where no name is a person's or a thing's that is known, all are people.
        """
        kept = [item for item in self.items if item.is_person or item.category == UNKNOWN]
        others = sorted({item.category for item in self.items} - {UNKNOWN})
        notes = list(self.notes)
        if not kept and others:
            kept = [item for item in self.items if unknown_names([item.category])]
            named = listed("name", [repr(name) for name in others])
            if not kept:
                wanted = "expected masks of people"
                raise InputError(f"{self.file}: has no people, only {named}, {wanted}")
            notes.append(f"{named} taken as people's")
        if bare := sum(item.mask is None for item in kept):
            notes.append(f"{self.file}: boxes without mask, which people need, left out: {bare}")
        return dataclasses.replace(self, items=tuple(kept), notes=tuple(notes))

    def objects_tree(self) -> At:
        """The fields of objects.json; ids are the ranks of the instances.

        Raises:
            InputError: If the size of the image is not known.
        """
        width, height = _size_of(self, "image")
        names = list(dict.fromkeys(item.category for item in self.items))
        rows: list[dict[str, Any]] = []
        for i, item in enumerate(self.items):
            row: dict[str, Any] = {"id": i, "category_id": item.category}
            if item.mask is not None:
                row["segmentation"] = segmentation(Masks(height, width, (item.mask,)), 0)
            x, y, right, bottom = _box_of(item, self.size)
            if x < right and y < bottom:  # else there is nothing of it in the image
                rows.append({**row, "bbox": [x, y, right - x, bottom - y], "score": item.score})
        image = {"width": width, "height": height}
        return At(annotations_tree(rows, image, names), self.file)

    def people_tree(self, fps: float | None = None) -> At:
        """The fields of people.json: everything is a person.

        Raises:
            InputError: If the size of the images is not known.
        """
        width, height = _size_of(self, "images")
        rows = [
            {"image_id": item.frame, "track_id": item.track, "category_id": 1,
             "segmentation": segmentation(Masks(height, width, (item.mask,)), 0)}
            for item in self.followed().items if item.mask is not None
        ]  # fmt: skip
        frames = sorted(self.frames | {item.frame for item in self.items})
        tree = {
            "info": {} if fps is None else {"fps": fps},
            "images": [{"id": f, "width": width, "height": height} for f in frames],
            "categories": [{"id": 1, "name": "person"}],
            "annotations": [{"id": i, **row} for i, row in enumerate(rows)],
        }
        return At(tree, self.file)

    def followed(self) -> "Instances":
        """The instances by frame, with a track each, by their places where they have none.

        Of one track and frame that with the best score counts. Tracks that are made are numbered
        from the left in the frame in which they start.
        """
        free = [item for item in self.items if item.track is None]
        best: dict[tuple[int, int], Instance] = {}
        for item in sorted(self.items, key=lambda i: -i.score):
            if item.track is not None:
                best.setdefault((item.frame, item.track), item)
        notes = self.notes
        if free:
            placed = [(item, _box_of(item, self.size)) for item in free]
            placed.sort(key=lambda pair: (pair[0].frame, pair[1][0] + pair[1][2]))
            free, boxes = [item for item, _ in placed], np.array([box for _, box in placed]) / 2
            sizes = np.linalg.norm(boxes[:, 2:] - boxes[:, :2], axis=1)
            frames = [item.frame for item in free]
            lone = len(set(frames)) == len(frames)  # never two at a time: it is one person
            tracks = [0] * len(free) if lone else bodies.followed(frames, boxes, sizes).tolist()
            used = {track for _, track in best}
            numbers = [n for n in range(len(used) + max(tracks) + 1) if n not in used]
            for item, track in zip(free, tracks, strict=True):
                key = item.frame, numbers[track]
                best[key] = dataclasses.replace(item, track=numbers[track])
            if len(free) > len(set(tracks)):
                how = "one in each frame, taken as the same" if lone else "followed by their places"
                notes = (*notes, f"{self.file}: people without tracks: {max(tracks) + 1}, {how}")
        items = tuple(best[key] for key in sorted(best))
        return dataclasses.replace(self, items=items, notes=notes)


def mask_code(at: At) -> dict[str, Any]:
    """The run-length code of rows of booleans, as MOVER's detections.json holds them."""
    try:
        pixels = np.asarray(at.value)
    except ValueError:
        return at.refuse("rows of booleans of one length")
    if pixels.ndim != 2 or pixels.dtype.kind not in "bui" or not pixels.size:
        at.refuse("rows of booleans of one length")
    return {"size": list(pixels.shape), "counts": encode(torch.from_numpy(pixels != 0)).decode()}


def code_of(pixels: NDArray[Any]) -> bytes | None:
    """The run-length code of an image of booleans; None where it is empty."""
    return encode(torch.from_numpy(np.ascontiguousarray(pixels))) if pixels.any() else None


def code_in(given: At | None, size: Size | None) -> bytes | None:
    """The code of COCO's polygons or run lengths in an image of this size; None: nothing there."""
    if given is None or not is_drawn(given.value):
        return None
    if size is None:
        given.refuse("the size of the image beside polygons: give --image")
    width, height = size
    code = from_coco(given, height, width)
    return code if area(Masks(height, width, (code,)), 0) else None


def frames_of(numbers: Sequence[int], what: str) -> tuple[dict[int, int], tuple[str, ...]]:
    """Frames, counted from 0, by the numbers that a source has for them; gaps stay gaps.

    Numbers whose first is 1 count from 1: a video's frame 0 is seldom the only one without a thing.
    Such as are too large for frames (ids of a data set) are counted in their order. Messages call
    them `what`.
    """
    known = sorted(set(numbers))
    if not known or known[0] == 0:
        return {n: n for n in known}, ()
    if known[-1] > LAST_INDEX:
        said = f"{what} up to {known[-1]} are no frames: images are counted in their order"
        return {n: rank for rank, n in enumerate(known)}, (said,) if len(known) > 1 else ()
    first = known[0] == 1
    gaps = known[-1] - known[0] + 1 - len(known)
    said = f"{what} {known[0]} to {known[-1]}" + (f" with {gaps} left out" if gaps else "")
    how = "count from 1: 1 is frame 0 of the video" if first else "are frames counted from 0"
    return {n: n - first for n in known}, (f"{said} {how}",) if len(known) > 1 else ()


def _size_of(found: Instances, what: str) -> Size:
    """Width and height [px]."""
    if found.size is None:
        raise InputError(f"{found.file}: has no size of the {what}, expected --image beside it")
    return found.size


def _box_of(item: Instance, size: Size | None) -> Sequence[float]:
    """The box of an instance: that of its mask where it has one [px]."""
    if item.mask is None or size is None:
        return item.box or (0.0, 0.0, 0.0, 0.0)
    return mask_boxes(Masks(size[1], size[0], (item.mask,)))[0].tolist()


def with_reference_people(people: At | None, found: Instances, folder: Path) -> At:
    """people.json (None: that of the folder, or none) with these masks in the reference image."""
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


CORNERS = 64  # of the polygon that stands for a circle
WITHOUT_AREA = ("point", "points", "line", "linestrip")


class LabelmeFields(Struct, frozen=True, rename="camel"):
    """A file of labelme: one picture."""

    image_width: Side
    image_height: Side
    shapes: list[Any]


class ShapeFields(Struct, frozen=True):
    """One of its shapes."""

    label: Text
    points: list[tuple[float, float]]
    shape_type: str = "polygon"
    group_id: int | None = None
    mask: str | None = None


def labelme_instances(at: At) -> Instances:
    """Labelme's areas; shapes of one label and `group_id` are one object."""
    from pycocotools import mask as coco

    tree = checked(at, LabelmeFields)
    size = tree.image_width, tree.image_height
    groups: dict[tuple[str, int | None], list[Any]] = {}
    items = at.get("shapes").items()
    areas = [x for x in items if x.mapping().get("shape_type") not in WITHOUT_AREA] or items
    for index, item in enumerate(areas):
        shape = checked(item, ShapeFields)
        kind = item.get("shape_type").choice(("polygon", "rectangle", "circle", "mask"))
        key = str(shape.label), -1 - index if shape.group_id is None else shape.group_id
        if kind == "mask":
            code = _pasted(item, shape, size)
        else:
            outline = [[v for point in _outline(kind, shape.points) for v in point]]
            code = code_in(dataclasses.replace(item.get("points"), value=outline), size)
        known = groups.setdefault(key, [])
        if code is not None:
            known.append({"size": [size[1], size[0]], "counts": code})
    found: list[Instance] = []
    for (label, _), codes in groups.items():
        whole: Any = coco.merge(codes) if codes else {}
        found.append(Instance(label, None, whole.get("counts")))
    said = f"{at.file}: shapes of points or lines passed over: {len(items) - len(areas)}"
    return Instances(tuple(found), size, at.file, notes=(said,) if areas != items else ())


def _outline(kind: str, points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The corners of a polygon, of a rectangle by two, or of a circle by middle and border."""
    if kind == "polygon" or len(points) != 2:
        return points
    (x0, y0), (x1, y1) = points
    if kind == "rectangle":
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    wide, turns = math.hypot(x1 - x0, y1 - y0), (math.tau * k / CORNERS for k in range(CORNERS))
    return [(x0 + wide * math.cos(turn), y0 + wide * math.sin(turn)) for turn in turns]


def _pasted(item: At, shape: ShapeFields, size: Size) -> bytes | None:
    """The mask of labelme's AI tools: a PNG in base64, whose first pixel lies at `points[0]`."""
    from PIL import Image

    (width, height), points = size, item.get("points")
    if not shape.points or not all(0 <= v < m for v, m in zip(shape.points[0], size, strict=True)):
        points.refuse("the corner of a mask in the image first")
    x, y = (int(v) for v in shape.points[0])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            png = io.BytesIO(base64.b64decode(shape.mask or "", validate=True))
            with Image.open(png, formats=["PNG"]) as picture:
                if picture.width > width or picture.height > height:
                    item.get("mask").refuse("a mask no larger than the image", f"{picture.size}")
                pixels = np.asarray(picture.convert("L")) > 0
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        item.get("mask").refuse("a PNG in base64", "what cannot be read")
    whole = np.zeros((height, width), dtype=bool)
    part = pixels[: height - y, : width - x]
    whole[y : y + part.shape[0], x : x + part.shape[1]] = part
    return code_of(whole)
