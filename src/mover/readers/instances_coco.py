"""COCO's JSON: images, categories, annotations."""

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
from .instances import LARGEST_SIDE, Instance, Instances, checked_code
from .parts import UNKNOWN

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
    words = {**_categories(at), **{int(k): v for k, v in names.items() if k.isdecimal()}}
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
