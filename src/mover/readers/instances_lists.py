"""Detections without COCO's frame: result lists, MOVER's detections.json, SA-V, SAM 3."""

from collections.abc import Mapping

from .fields import (
    LAST_ID,
    LAST_INDEX,
    At,
    get,
    integer,
    items,
    maybe,
    number,
    refuse,
    text,
    vector,
)
from .instances import LARGEST_SIDE, Instance, Instances, checked_code, mask_code
from .instances_coco import COCO_CLASSES, COCO_IDS
from .parts import UNKNOWN


def list_instances(at: At, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """A list of detections: COCO's and detectron2's results, or those of MOVER with rows of pixels.

    An item has `class` (a name) or `category_id`; `bbox` and `segmentation` or `mask`. COCO's ids
    have gaps; a file whose ids only make sense counted from 0 (detectron2) is read so.

    Raises:
        InputError: If a field is wrong.
    """
    rows = items(at)
    words = _words(rows, names)
    frames = _frames(rows)
    found: list[Instance] = []
    for row in rows:
        own = _size_of(row) or size
        instance = _instance(row, own, words, frames)
        size = own
        found.append(instance)
    return Instances(tuple(found), size, at.file)


def _size_of(row: At) -> tuple[int, int] | None:
    """Width and height of the image of an item, where its mask tells."""
    given = maybe(row, "segmentation")
    if given is not None and isinstance(given.value, dict):
        height, width = (integer(v, 1, LARGEST_SIDE) for v in items(get(given, "size"), 2))
        return width, height
    mask = maybe(row, "mask")
    if mask is not None and isinstance(mask.value, list) and mask.value:
        height, width = mask_code(mask)["size"]
        return width, height
    return None


def _frames(rows: list[At]) -> dict[int, int]:
    """Frame of each image id, in their order."""
    ids = {integer(key, 0, LAST_ID) for row in rows if (key := maybe(row, "image_id")) is not None}
    return {key: place for place, key in enumerate(sorted(ids))}


def _words(rows: list[At], names: Mapping[str, str]) -> dict[int, str]:
    """Names by category id."""
    keys = [integer(k, 0, LAST_ID) for row in rows if (k := maybe(row, "category_id")) is not None]
    contiguous = any(key not in COCO_IDS for key in keys) and all(key < 80 for key in keys)
    table = enumerate(COCO_CLASSES) if contiguous else zip(COCO_IDS, COCO_CLASSES, strict=True)
    return {**dict(table), **{int(k): v for k, v in names.items() if k.isdecimal()}}


def _instance(
    row: At, size: tuple[int, int] | None, words: Mapping[int, str], frames: Mapping[int, int]
) -> Instance:
    """One detection."""
    named, key, score = maybe(row, "class"), maybe(row, "category_id"), maybe(row, "score")
    image, track = maybe(row, "image_id"), maybe(row, "track_id")
    box, last = _corners(row)
    if score is not None:
        last = number(score, 0, 1)
    category = UNKNOWN if key is None else words.get(key.value, UNKNOWN)
    return Instance(
        category=category if named is None else text(named),
        box=box,
        mask=_mask(row, size),
        score=last,
        frame=0 if image is None else frames[image.value],
        track=None if track is None else integer(track),
    )


def _corners(row: At) -> tuple[tuple[float, ...] | None, float]:
    """Box and score: MOVER's are corners with the score behind, COCO's have width and height."""
    given = maybe(row, "bbox")
    if given is None:
        return None, 1.0
    if isinstance(given.value, list) and len(given.value) == 5:
        *box, score = vector(given, 5)
        return tuple(box), number(At(score, given.file, given.field), 0, 1)
    a, b, c, d = vector(given, 4)
    of_class = maybe(row, "class") is not None
    return ((a, b, c, d) if of_class else (a, b, a + c, b + d)), 1.0


def _mask(row: At, size: tuple[int, int] | None) -> bytes | None:
    """The mask of an item, None where it has none."""
    given, pixels = maybe(row, "segmentation"), maybe(row, "mask")
    if pixels is not None and isinstance(pixels.value, list):
        code = mask_code(pixels)
        height, width = code["size"]
        return checked_code(code, (width, height), pixels)
    if given is None:
        return None
    if size is None:
        refuse(given, "the size of the image beside polygons: give --image")
    return checked_code(given.value, size, given)


def masklets(at: At, names: Mapping[str, str]) -> Instances:
    """SA-V's masklet[frame][object]; the objects have no names.

    Raises:
        InputError: If a field is wrong.
    """
    width = round(number(get(at, "video_width"), 1, LARGEST_SIDE))
    height = round(number(get(at, "video_height"), 1, LARGEST_SIDE))
    ids = maybe(at, "masklet_id")
    tracks = None if ids is None else [integer(key) for key in items(ids)]
    found: list[Instance] = []
    for frame, row in enumerate(items(get(at, "masklet"))):
        for place, item in enumerate(items(row)):
            code = None
            if item.value is not None:
                code = checked_code(item.value, (width, height), item)
            track = tracks[place] if tracks is not None and place < len(tracks) else place
            name = names.get(str(track), UNKNOWN)
            if code is not None:
                found.append(Instance(name, None, code, frame=min(frame, LAST_INDEX), track=track))
    return Instances(tuple(found), (width, height), at.file)


def sam3_instances(at: At, names: Mapping[str, str]) -> Instances:
    """SAM 3's answers: codes without sizes, boxes as shares of the image.

    Raises:
        InputError: If a field is wrong.
    """
    width = integer(get(at, "orig_img_w"), 1, LARGEST_SIDE)
    height = integer(get(at, "orig_img_h"), 1, LARGEST_SIDE)
    codes = items(get(at, "pred_masks"))
    scores = maybe(at, "pred_scores")
    values = [1.0] * len(codes)
    if scores is not None:
        values = [number(v, 0, 1) for v in items(scores, len(codes))]
    found: list[Instance] = []
    for i, code in enumerate(codes):
        counts = {"size": [height, width], "counts": code.value}
        mask = checked_code(counts, (width, height), code)
        found.append(Instance(names.get(str(i), UNKNOWN), None, mask, values[i]))
    return Instances(tuple(found), (width, height), at.file)
