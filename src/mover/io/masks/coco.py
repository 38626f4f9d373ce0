"""COCO: images, categories, masks as polygons or run-length codes."""

import ast
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from mover.core.types import Camera, Masks
from mover.geometry.rle import run_lengths
from mover.io.files.fields import LAST_ID, At, Warn, unique
from mover.io.files.schema import Id, Text, checked

COCO_CLASSES = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat",
    "traffic light", "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog",
    "horse", "sheep", "cow", "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella",
    "handbag", "tie", "suitcase", "frisbee", "skis", "snowboard", "sports ball", "kite",
    "baseball bat", "baseball glove", "skateboard", "surfboard", "tennis racket", "bottle",
    "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple", "sandwich",
    "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote",
    "keyboard", "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book",
    "clock", "vase", "scissors", "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
"""The 80 classes in COCO's order; some tools count them from 0."""
GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Ids that COCO leaves out."""
COCO_IDS = tuple(n for n in range(1, 91) if n not in GAPS)
"""COCO's own ids of its classes."""
MOST_THINGS = 5000  # in one picture
MOST_CODES = 200_000  # that were found right and are kept, some 400 bytes each
_CODES = dict[tuple[str, tuple[int, int]], bytes]()
CORNERS = 3  # a polygon has at least so many


def from_coco(at: At, height: int, width: int) -> bytes:
    """The compressed run-length code of COCO's polygons or of either of its run-length codes.

    Height and width are those of the image [px].

    Raises:
        InputError: If it is malformed or does not fit the image. It may be empty.
    """
    from pycocotools import mask as coco

    segmentation: Any = at.value
    if isinstance(segmentation, str):  # printed by Python, or a code that belongs to this image
        whole = {"size": [height, width], "counts": segmentation}
        start = segmentation.strip()[:1]
        segmentation = _unprinted(segmentation, whole) if start in ("{", "[") else whole
    if isinstance(segmentation, list | tuple):
        polygons = _nested(segmentation)
        if not polygons:
            at.refuse("[[x, y, ...], ...]", "no polygon")
        for i, polygon in enumerate(polygons):
            _check_polygon(polygon, 2 * max(height, width), at, f"polygon {i} with")
        outlines: Any = [[float(v) for v in polygon] for polygon in polygons]
        return coco.merge(coco.frPyObjects(outlines, height, width))["counts"]  # pyright: ignore
    if not isinstance(segmentation, dict):
        kinds = "polygons [[x, y, ...], ...] or a run-length code {size, counts}"
        at.refuse(kinds, type(segmentation).__name__)
    return _run_code(segmentation, (height, width), at)


def _run_code(given: dict[str, Any], whole: tuple[int, int], at: At) -> bytes:
    """The compressed code of either run-length code, checked once for each text."""
    from pycocotools import mask as coco

    size, counts = given.get("size"), given.get("counts")
    size = _unprinted(size, size) if isinstance(size, str) else size
    if not isinstance(size, list | tuple) or tuple(size) != whole:
        at.refuse(f"{list(whole)} (h, w)", f"size {str(size)[:40]}")
    if isinstance(counts, str) and (counts, whole) in _CODES:
        return _CODES[counts, whole]
    runs = _runs(counts, at)
    if (runs < 0).any() or runs.sum() != whole[0] * whole[1]:
        found = f"runs that sum to {runs.sum()}" if (runs >= 0).all() else "a negative run"
        at.refuse(f"runs that sum to {whole[0]} x {whole[1]}", f"counts with {found}")
    if isinstance(counts, bytes):
        return counts
    tree: Any = {"size": list(whole), "counts": runs.tolist()}
    code: bytes = coco.frPyObjects(tree, *whole)["counts"]  # pyright: ignore
    if isinstance(counts, str) and len(_CODES) < MOST_CODES:  # a file is read to be merged, again
        _CODES[counts, whole] = code
    return code


def _unprinted(written: str, other: Any) -> Any:  # noqa: ANN401
    """What Python printed as this text; `other` where it is none of that."""
    with suppress(ValueError, SyntaxError, MemoryError, RecursionError):
        return ast.literal_eval(written.strip())
    return other


def _nested(polygons: Sequence[Any]) -> Sequence[Any]:
    """Polygons, where a single one may be written as x, y, ... or as pairs (x, y)."""
    if polygons and all(type(v) in (int, float) for v in polygons):
        return [polygons]
    if len(polygons) >= CORNERS and _are_pairs(polygons):
        polygons = [polygons]
    flat = [[v for pair in p for v in pair] if _are_pairs(p) else p for p in polygons]
    return [p for p in flat if p not in ([], ())]


def _are_pairs(polygon: Any) -> bool:  # noqa: ANN401
    """Whether corners are written as pairs (x, y)."""
    pairs = polygon if isinstance(polygon, list | tuple) else ()
    return bool(pairs) and all(isinstance(p, list | tuple) and len(p) == 2 for p in pairs)


def is_drawn(segmentation: Any) -> bool:  # noqa: ANN401
    """Whether there is a mask: tools write [], [[]] or null beside boxes."""
    if isinstance(segmentation, list | tuple):
        return any(part not in ([], (), None) for part in segmentation)
    return segmentation is not None


def _runs(counts: Any, at: At) -> NDArray[np.int64]:  # noqa: ANN401
    """The runs of a code of either kind, which Python may have printed."""
    if isinstance(counts, str) and re.fullmatch(r"b'.*'|b\".*\"|\[.*]", counts.strip()):
        counts = _unprinted(counts, counts)
    if isinstance(counts, list | tuple):
        if not all(type(n) is int and abs(n) < 1 << 40 for n in counts):
            at.refuse("whole numbers in it", "a list of counts")
        return np.array(counts, dtype=np.int64)
    if not isinstance(counts, str | bytes):
        found = f"{type(counts).__name__} as counts"
        at.refuse("a list of runs or a compressed code", found)
    try:
        return run_lengths(counts if isinstance(counts, bytes) else counts.encode("ascii"))
    except ValueError as error:
        coded = re.match(r"iVBOR|/9j/|data:image", str(counts))
        found = f"counts with {error}"
        at.refuse("COCO's compressed code", "a picture in base64" if coded else found)


def _check_polygon(polygon: Any, reach: float, at: At, what: str) -> None:  # noqa: ANN401
    """Refuse what the rasteriser would crash on or draw as nonsense."""
    given: Any = polygon if isinstance(polygon, list | tuple) else ()
    words = [v for v in given if isinstance(v, str)]
    if words:
        at.refuse("numbers x, y without quotes", f"{what} text ({words[0][:40]!r})")
    real = all(type(v) in (int, float) for v in given)
    if not real or len(given) < 2 * CORNERS or len(given) % 2:
        count = f"{len(given)} numbers{', an odd count' if len(given) % 2 else ''}"
        found = count if polygon is given and real else str(polygon)[:40]
        at.refuse(f"numbers x, y of {CORNERS} corners or more", f"{what} {found}")
    if not all(-reach <= v <= reach for v in given):
        at.refuse("pixels of the image", f"{what} a corner far outside")
    if all(0 <= v <= 1 for v in given) and any(0 < v < 1 for v in given):
        at.refuse("pixels: times width and height", f"{what} shares of the image (0 to 1)")


def check_image(at: At, camera: Camera) -> int:
    """The id of an image, whose size must be the camera's."""
    for key, size in (("width", camera.width), ("height", camera.height)):
        given = at.maybe(key)
        if given is not None and given.integer() != size:
            given.refuse(f"{size}, as the camera has")
    return at.get("id").integer()


class CategoryFields(Struct, frozen=True):
    """One of `categories`."""

    id: Id
    name: Text


def categories_of(at: At) -> dict[int, str]:
    """Names by id."""
    rows, seen = checked(at, list[CategoryFields]), set[object]()
    for item, row in zip(at.items(), rows, strict=True):
        unique(item.get("id"), seen, row.id, "an id")
    return {row.id: str(row.name) for row in rows}


def category_of(at: At, names: dict[int, str]) -> str:
    """The name of a category."""
    key = at.integer(0, LAST_ID)
    if key not in names:
        at.refuse("the id of one of the categories")
    return names[key]


def mask_of(at: At, camera: Camera, warn: Warn) -> Masks | None:
    """The mask of an annotation, None without segmentation."""
    given = at.maybe("segmentation")
    if given is None or not is_drawn(given.value):
        return None
    size, polygons = (camera.height, camera.width), isinstance(given.value, list)
    code = from_coco(given, *size)
    for k, side in ((0, camera.width), (1, camera.height)) if polygons else ():
        ends = [v for polygon in _nested(given.value) for v in polygon[k::2]]
        if min(ends) < -1 or max(ends) > side + 1:  # by more than a pixel
            warn(f"{given.place} leaves the image and was clipped")
            break
    return Masks(*size, (code,))


def annotations_tree(
    rows: Sequence[Mapping[str, Any]],
    image: Mapping[str, Any],
    names: Sequence[str] | None = None,
    first: int = 0,
) -> dict[str, Any]:
    """The content of objects.json of rows that have the names of their categories as ids.

    They are annotations of one `image`, whose id is 0. The ids of all categories (None: those of
    the rows) start at `first`.
    """
    names = list(dict.fromkeys(row["category_id"] for row in rows)) if names is None else names
    known = {name: first + i for i, name in enumerate(names)}
    return {
        "images": [{**image, "id": 0}],
        "categories": [{"id": key, "name": name} for name, key in known.items()],
        "annotations": [
            {**row, "image_id": 0, "category_id": known[row["category_id"]]} for row in rows
        ],
    }


def segmentation(masks: Masks, index: int) -> dict[str, Any]:
    """The JSON object of a mask."""
    counts = masks.counts[index].decode("ascii")
    return {"size": [masks.height, masks.width], "counts": counts}
