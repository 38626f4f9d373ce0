"""JSON: COCO's, result lists, MOVER's detections.json, SA-V's masklets, SAM 3's answers."""

from collections.abc import Mapping

from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import (
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
from mover.io.masks.instances import LARGEST_SIDE, Instance, Instances, checked_code, mask_code

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
"""The 80 classes in COCO's order; detectron2 counts them from 0."""
GAPS = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""Ids that COCO leaves out."""
COCO_IDS = tuple(n for n in range(1, 91) if n not in GAPS)
"""COCO's own ids of its classes."""


def coco_instances(at: At, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """The annotations of a COCO file; frames are its images in the order of their ids.

    Raises:
        InputError: If a field is wrong.
    """
    sizes: dict[int, tuple[int, int]] = {}
    for item in items(get(at, "images")):
        known = [maybe(item, key) for key in ("width", "height")]
        own = size
        if known[0] is not None and known[1] is not None:
            own = integer(known[0], 1, LARGEST_SIDE), integer(known[1], 1, LARGEST_SIDE)
        if own is None:
            refuse(item, "width and height, here or by --image")
        sizes[integer(get(item, "id"), 0, LAST_ID)] = own
    words = {**_categories(at), **_numbered(names)}
    frames = _frames(at, sorted(sizes))
    found: list[Instance] = []
    for item in items(get(at, "annotations")):
        key = integer(get(item, "image_id"), 0, LAST_ID)
        if key not in sizes:
            refuse(get(item, "image_id"), "the id of one of the images")
        found.append(_instance(item, sizes[key], frames[key], words))
    if len(set(sizes.values())) > 1:
        refuse(get(at, "images"), "images of one size", f"{len(set(sizes.values()))} sizes")
    return Instances(tuple(found), next(iter(sizes.values()), size), at.file)


def _frames(at: At, ids: list[int]) -> dict[int, int]:
    """Frame of each image: its id where people are tracked, else its place in order."""
    tracked = any(
        isinstance(row.value, dict) and "track_id" in row.value
        for row in items(get(at, "annotations"))
    )
    if tracked and (not ids or ids[-1] <= LAST_INDEX):
        return {key: key for key in ids}
    return {key: place for place, key in enumerate(ids)}


def _categories(at: At) -> dict[int, str]:
    """Names by id; COCO's own where the file has none."""
    if maybe(at, "categories") is None:
        return dict(zip(COCO_IDS, COCO_CLASSES, strict=True))
    rows = items(get(at, "categories"))
    return {integer(get(row, "id"), 0, LAST_ID): text(get(row, "name")) for row in rows}


def _instance(at: At, size: tuple[int, int], frame: int, words: Mapping[int, str]) -> Instance:
    """One annotation."""
    category, box, score = maybe(at, "category_id"), maybe(at, "bbox"), maybe(at, "score")
    given, track = maybe(at, "segmentation"), maybe(at, "track_id")
    key = None if category is None else integer(category, 0, LAST_ID)
    if key is not None and key not in words:
        refuse(get(at, "category_id"), "the id of one of the categories")
    corners = None
    if box is not None:
        x, y, w, h = vector(box, 4)
        corners = (x, y, x + w, y + h)
    if corners is None and given is None:
        refuse(at, "an annotation with bbox or segmentation")
    empty = given is None or given.value == []
    return Instance(
        category=UNKNOWN if key is None else words[key],
        box=corners,
        mask=None if given is None or empty else checked_code(given.value, size, given),
        score=1.0 if score is None else number(score, 0, 1),
        frame=frame,
        track=None if track is None else integer(track),
    )


def list_instances(at: At, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """A list of detections: COCO's and detectron2's results, or those of MOVER with rows of pixels.

    An item has `class` (a name) or `category_id`; `bbox` and `segmentation` or `mask`. COCO's ids
    have gaps; a file whose ids only make sense counted from 0 (detectron2) is read so.

    Raises:
        InputError: If a field is wrong.
    """
    rows = items(at)
    words = _words(rows, names)
    frames = {key: place for place, key in enumerate(sorted(set(_ids(rows, "image_id"))))}
    found: list[Instance] = []
    for row in rows:
        size = _size_of(row) or size
        found.append(_detection(row, size, words, frames))
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


def _ids(rows: list[At], key: str) -> list[int]:
    """The ids that rows have under a key."""
    return [integer(given, 0, LAST_ID) for row in rows if (given := maybe(row, key)) is not None]


def _words(rows: list[At], names: Mapping[str, str]) -> dict[int, str]:
    """Names by category id."""
    keys = _ids(rows, "category_id")
    contiguous = any(key not in COCO_IDS for key in keys) and all(key < 80 for key in keys)
    table = enumerate(COCO_CLASSES) if contiguous else zip(COCO_IDS, COCO_CLASSES, strict=True)
    return {**dict(table), **_numbered(names)}


def _numbered(names: Mapping[str, str]) -> dict[int, str]:
    """The user's names by category id."""
    return {int(key): name for key, name in names.items() if key.isdecimal()}


def _detection(
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
            given = item.value
            code = None if given is None else checked_code(given, (width, height), item)
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
