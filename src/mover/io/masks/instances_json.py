"""JSON: COCO's, result lists, MOVER's detections.json, SA-V's masklets, SAM 3's answers."""

from collections.abc import Mapping
from typing import Annotated, Any

from msgspec import Meta, Struct, field

from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import LAST_INDEX, At, get, items, maybe, number, refuse, vector
from mover.io.files.schema import LARGEST_SIDE, Id, Index, Share, Side, Text, checked
from mover.io.masks.coco import CategoryFields
from mover.io.masks.instances import Instance, Instances, checked_code, mask_code

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
Size = tuple[int, int]
"""Width and height of an image [px]."""


class ImageFields(Struct, frozen=True):
    """One of COCO's `images`."""

    id: Id
    width: Side | None = None
    height: Side | None = None


class RowFields(Struct, frozen=True):
    """An annotation of COCO, or a detection of any tool."""

    image_id: Id | None = None
    category_id: Id | None = None
    name: Text | None = field(default=None, name="class")
    bbox: list[Any] | None = None
    score: Share | None = None
    segmentation: Any = None
    mask: Any = None
    track_id: Index | None = None


def coco_instances(at: At, names: Mapping[str, str], size: Size | None) -> Instances:
    """The annotations of a COCO file; frames are its images in the order of their ids."""
    sizes = dict(_size_of_image(item, size) for item in items(get(at, "images")))
    words = {**_categories(at), **_numbered(names)}
    rows = [(item, checked(item, RowFields)) for item in items(get(at, "annotations"))]
    frames = {key: place for place, key in enumerate(sorted(sizes))}
    if any(row.track_id is not None for _, row in rows) and max(sizes, default=0) <= LAST_INDEX:
        frames = {key: key for key in sizes}  # where people are tracked ids are frames
    found: list[Instance] = []
    for item, row in rows:
        if row.image_id not in sizes:
            refuse(get(item, "image_id"), "the id of one of the images")
        if row.category_id is not None and row.category_id not in words:
            refuse(get(item, "category_id"), "the id of one of the categories")
        if row.bbox is None and row.segmentation is None:
            refuse(item, "an annotation with bbox or segmentation")
        found.append(_instance(item, row, sizes[row.image_id], words, frames))
    if len(set(sizes.values())) > 1:
        refuse(get(at, "images"), "images of one size", f"{len(set(sizes.values()))} sizes")
    return Instances(tuple(found), next(iter(sizes.values()), size), at.file)


def _size_of_image(at: At, size: Size | None) -> tuple[int, Size]:
    """Id and size of an image."""
    image = checked(at, ImageFields)
    own = (image.width, image.height) if image.width and image.height else size
    if own is None:
        refuse(at, "width and height, here or by --image")
    return image.id, own


def _categories(at: At) -> dict[int, str]:
    """Names by id; COCO's own where the file has none."""
    given = maybe(at, "categories")
    if given is None:
        return dict(zip(COCO_IDS, COCO_CLASSES, strict=True))
    return {row.id: str(row.name) for row in checked(given, list[CategoryFields])}


def _numbered(names: Mapping[str, str]) -> dict[int, str]:
    """The user's names by category id."""
    return {int(key): name for key, name in names.items() if key.isdecimal()}


def list_instances(at: At, names: Mapping[str, str], size: Size | None) -> Instances:
    """A list of detections: COCO's and detectron2's results, or those of MOVER with rows of pixels.

    An item has `class` (a name) or `category_id`; `bbox` and `segmentation` or `mask`. COCO's ids
    have gaps; a file whose ids only make sense counted from 0 (detectron2) is read so.
    """
    rows = [(item, checked(item, RowFields)) for item in items(at)]
    keys = {row.category_id for _, row in rows if row.category_id is not None}
    contiguous = not keys <= set(COCO_IDS) and max(keys) < len(COCO_CLASSES)
    table = enumerate(COCO_CLASSES) if contiguous else zip(COCO_IDS, COCO_CLASSES, strict=True)
    words = {**dict(table), **_numbered(names)}
    images = sorted({row.image_id for _, row in rows if row.image_id is not None})
    frames = {key: place for place, key in enumerate(images)}
    found: list[Instance] = []
    for item, row in rows:
        size = _size_of(item, row) or size
        found.append(_instance(item, row, size, words, frames))
    return Instances(tuple(found), size, at.file)


def _size_of(at: At, row: RowFields) -> Size | None:
    """Width and height of the image of an item, where its mask tells."""
    if isinstance(row.segmentation, dict):
        height, width = checked(get(get(at, "segmentation"), "size"), tuple[Side, Side])
        return width, height
    if isinstance(row.mask, list) and row.mask:
        height, width = mask_code(get(at, "mask"))["size"]
        return width, height
    return None


def _instance(
    at: At, row: RowFields, size: Size | None, words: Mapping[int, str], frames: Mapping[int, int]
) -> Instance:
    box, score = _corners(at, row)
    key = -1 if row.category_id is None else row.category_id
    return Instance(
        category=words.get(key, UNKNOWN) if row.name is None else str(row.name),
        box=box,
        mask=_mask(at, row, size),
        score=score if row.score is None else row.score,
        frame=0 if row.image_id is None else frames[row.image_id],
        track=row.track_id,
    )


def _corners(at: At, row: RowFields) -> tuple[tuple[float, ...] | None, float]:
    """Box and score: MOVER's are corners with the score behind, COCO's have width and height."""
    if row.bbox is None:
        return None, 1.0
    box = get(at, "bbox")
    if len(row.bbox) == 5 and row.category_id is None:
        *corners, score = vector(box, 5)
        return tuple(corners), number(At(score, box.file, box.field), 0, 1)
    a, b, c, d = vector(box, 4)
    return ((a, b, a + c, b + d) if row.name is None else (a, b, c, d)), 1.0


def _mask(at: At, row: RowFields, size: Size | None) -> bytes | None:
    """The mask of an item, None where it has none."""
    given = get(at, "segmentation")
    if isinstance(row.mask, list):
        given = get(at, "mask")
        code = mask_code(given)
        return checked_code(code, (code["size"][1], code["size"][0]), given)
    if row.segmentation is None or row.segmentation == []:
        return None
    if size is None:
        refuse(given, "the size of the image beside polygons: give --image")
    return checked_code(row.segmentation, size, given)


class MaskletFields(Struct, frozen=True):
    """SA-V's file."""

    video_width: Annotated[float, Meta(ge=1, le=LARGEST_SIDE)]
    video_height: Annotated[float, Meta(ge=1, le=LARGEST_SIDE)]
    masklet: list[list[Any]]
    masklet_id: list[Index] | None = None


def masklets(at: At, names: Mapping[str, str]) -> Instances:
    """SA-V's masklet[frame][object]; the objects have no names."""
    tree = checked(at, MaskletFields)
    size, tracks = (round(tree.video_width), round(tree.video_height)), tree.masklet_id or []
    found: list[Instance] = []
    for frame, row in enumerate(items(get(at, "masklet"))):
        for place, item in enumerate(items(row)):
            code = None if item.value is None else checked_code(item.value, size, item)
            track = tracks[place] if place < len(tracks) else place
            name = names.get(str(track), UNKNOWN)
            if code is not None:
                found.append(Instance(name, None, code, frame=min(frame, LAST_INDEX), track=track))
    return Instances(tuple(found), size, at.file)


class Sam3Fields(Struct, frozen=True):
    """SAM 3's answer."""

    orig_img_w: Side
    orig_img_h: Side
    pred_masks: list[Any]
    pred_scores: list[Share] | None = None


def sam3_instances(at: At, names: Mapping[str, str]) -> Instances:
    """SAM 3's answers: codes without sizes, boxes as shares of the image."""
    tree = checked(at, Sam3Fields)
    size, codes, scores = (tree.orig_img_w, tree.orig_img_h), tree.pred_masks, tree.pred_scores
    if scores is not None:
        items(get(at, "pred_scores"), len(codes))
    found: list[Instance] = []
    for i, code in enumerate(items(get(at, "pred_masks"))):
        counts = {"size": [size[1], size[0]], "counts": code.value}
        score = 1.0 if scores is None else scores[i]
        mask = checked_code(counts, size, code)
        found.append(Instance(names.get(str(i), UNKNOWN), None, mask, score))
    return Instances(tuple(found), size, at.file)
