"""Files of masks: COCO, lists of detections and labelme (JSON), pictures, arrays."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from mover.core.errors import InputError
from mover.io.capture.parts import UNKNOWN, Hints, Parts
from mover.io.files.fields import (
    LAST_INDEX,
    At,
    choice,
    get,
    items,
    maybe,
    number,
    read_json,
    refuse,
    vector,
)
from mover.io.files.images import image_size
from mover.io.files.schema import Id, Index, Share, Side, Text, checked
from mover.io.masks.coco import CategoryFields
from mover.io.masks.instances import (
    Instance,
    Instances,
    checked_code,
    fitted,
    is_person,
    mask_code,
    objects_tree,
)
from mover.io.masks.instances_pixels import read_mask_arrays, read_mask_pictures

DETECTIONS = "detections.json"
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
Size = tuple[int, int]
"""Width and height of an image [px]."""
Names = Mapping[str, str]
"""Categories where the source has none: by number, file name or index."""


def mask_parts(source: Path, hints: Hints) -> Parts:
    """The objects of a file of masks."""
    size = None if hints.image is None else image_size(hints.image)
    found = fitted(read_instances(source, hints.names, size), size)
    things = [item for item in found.items if not is_person(item)]
    return Parts(name=source.stem, objects=objects_tree(found, things))


def read_instances(path: Path, names: Names, size: Size | None) -> Instances:
    """The instances of any known file or folder of masks.

    Args:
        path: A .json, .npz, .npy or .png file, or a folder.
        names: Categories where the source has none.
        size: Width and height of the image, for sources without it [px].
    """
    if path.is_dir():
        return _of_folder(path, names, size)
    match path.suffix.lower():
        case ".json":
            return _of_json(read_json(path), names, size)
        case ".npz" | ".npy":
            return read_mask_arrays(path, names)
        case ".png":
            return read_mask_pictures([path], path, names, size)
        case _:
            kinds = ".json, .npz, .npy, .png or a folder of pictures"
            raise InputError(f"{path}: is no file of masks, expected {kinds}")


def _of_json(at: At, names: Names, size: Size | None) -> Instances:
    """JSON, by its keys."""
    keys = set(at.value) if isinstance(at.value, dict) else set[str]()
    if "annotations" in keys:
        return coco_instances(at, names, size)
    if "shapes" in keys:
        return labelme_instances(at)
    if isinstance(at.value, list):
        return list_instances(at, names, size)
    known = "COCO's 'annotations', labelme's 'shapes' or a list of detections"
    raise InputError(f"{at.file}: has the keys {sorted(keys)[:5]}, expected {known}")


def _of_folder(folder: Path, names: Names, size: Size | None) -> Instances:
    """Pictures, or MOVER's `<frame>/detections.json`, whose frames count from the first."""
    frames = sorted(p for p in folder.iterdir() if p.is_dir() and (p / DETECTIONS).is_file())
    pictures = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".png")
    if not frames and not pictures:
        expected = f"pictures (.png), or folders of frames with {DETECTIONS}"
        raise InputError(f"{folder}: has no masks, expected {expected}")
    if not frames:
        return read_mask_pictures(pictures, folder, names, size)
    found, sizes = list[Instance](), set[Size]()
    first = 1 if frames[0].name.isdecimal() and int(frames[0].name) == 1 else 0
    for index, frame in enumerate(frames):
        number = int(frame.name) - first if frame.name.isdecimal() else index
        one = list_instances(read_json(frame / DETECTIONS), names, size)
        found += [dataclasses.replace(item, frame=number) for item in one.items]
        sizes |= set() if one.size is None else {one.size}
    if len(sizes) > 1:
        raise InputError(f"{folder}: has images of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), sizes.pop() if sizes else size, folder.name)


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


def coco_instances(at: At, names: Names, size: Size | None) -> Instances:
    """The annotations of a COCO file; frames are its images in the order of their ids."""
    sizes: dict[int, Size] = {}
    for item in items(get(at, "images")):
        image = checked(item, ImageFields)
        own = (image.width, image.height) if image.width and image.height else size
        if own is None:
            refuse(item, "width and height, here or by --image")
        sizes[image.id] = own
    given = maybe(at, "categories")
    words = dict(zip(COCO_IDS, COCO_CLASSES, strict=True))
    if given is not None:
        words = {row.id: str(row.name) for row in checked(given, list[CategoryFields])}
    words |= {int(key): name for key, name in names.items() if key.isdecimal()}
    rows = [(item, checked(item, RowFields)) for item in items(get(at, "annotations"))]
    frames = {key: rank for rank, key in enumerate(sorted(sizes))}
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


def list_instances(at: At, names: Names, size: Size | None) -> Instances:
    """A list of detections: COCO's results, or those of MOVER with rows of pixels.

    An item has `class` (a name) or `category_id`; `bbox` and `segmentation` or `mask`. COCO's ids
    have gaps; a file whose ids only make sense counted from 0 is read so.
    """
    rows = [(item, checked(item, RowFields)) for item in items(at)]
    keys = {row.category_id for _, row in rows if row.category_id is not None}
    contiguous = not keys <= set(COCO_IDS) and max(keys) < len(COCO_CLASSES)
    table = enumerate(COCO_CLASSES) if contiguous else zip(COCO_IDS, COCO_CLASSES, strict=True)
    words = dict(table) | {int(key): name for key, name in names.items() if key.isdecimal()}
    images = sorted({row.image_id for _, row in rows if row.image_id is not None})
    frames = {key: rank for rank, key in enumerate(images)}
    found: list[Instance] = []
    for item, row in rows:
        if isinstance(row.segmentation, dict):
            height, width = checked(get(get(item, "segmentation"), "size"), tuple[Side, Side])
            size = width, height
        elif isinstance(row.mask, list) and row.mask:
            height, width = mask_code(get(item, "mask"))["size"]
            size = width, height
        found.append(_instance(item, row, size, words, frames))
    return Instances(tuple(found), size, at.file)


def _instance(
    at: At, row: RowFields, size: Size | None, words: Mapping[int, str], frames: Mapping[int, int]
) -> Instance:
    """One row. MOVER's boxes are corners with the score behind, COCO's have width and height."""
    box, score = None, row.score
    if row.bbox is not None and len(row.bbox) == 5 and row.category_id is None:
        *box, last = vector(get(at, "bbox"), 5)
        score = number(At(last, at.file, f"{at.field}.bbox"), 0, 1) if score is None else score
    elif row.bbox is not None:
        a, b, c, d = vector(get(at, "bbox"), 4)
        box = (a, b, a + c, b + d) if row.name is None else (a, b, c, d)
    given, mask = get(at, "segmentation"), None
    if isinstance(row.mask, list):
        given = get(at, "mask")
        code = mask_code(given)
        mask = checked_code(code, (code["size"][1], code["size"][0]), given)
    elif row.segmentation is not None and row.segmentation != []:
        if size is None:
            refuse(given, "the size of the image beside polygons: give --image")
        mask = checked_code(row.segmentation, size, given)
    key = -1 if row.category_id is None else row.category_id
    return Instance(
        category=words.get(key, UNKNOWN) if row.name is None else str(row.name),
        box=None if box is None else tuple(box),
        mask=mask,
        score=1.0 if score is None else score,
        frame=0 if row.image_id is None else frames[row.image_id],
        track=row.track_id,
    )


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


def labelme_instances(at: At) -> Instances:
    """Labelme's polygons and rectangles; shapes of one label and `group_id` are one object."""
    tree = checked(at, LabelmeFields)
    size = tree.image_width, tree.image_height
    groups: dict[tuple[str, int | None], list[list[float]]] = {}
    first: dict[tuple[str, int | None], At] = {}
    for index, item in enumerate(items(get(at, "shapes"))):
        shape = checked(item, ShapeFields)
        kind = choice(get(item, "shape_type"), ("polygon", "rectangle"))
        points = shape.points
        if kind == "rectangle" and len(points) == 2:
            (x0, y0), (x1, y1) = points
            points = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        key = str(shape.label), -1 - index if shape.group_id is None else shape.group_id
        groups.setdefault(key, []).append([v for point in points for v in point])
        first.setdefault(key, get(item, "points"))
    found = [
        Instance(key[0], None, checked_code(polygons, size, first[key]))
        for key, polygons in groups.items()
    ]
    return Instances(tuple(found), size, at.file)
