"""Files of masks: COCO, lists of detections and labelme (JSON), pictures, arrays."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.io.capture.parts import UNKNOWN, Hints, Parts
from mover.io.files.fields import (
    LAST_INDEX,
    At,
    array,
    choice,
    get,
    items,
    mapping,
    maybe,
    number,
    read_json,
    refuse,
    text,
    vector,
)
from mover.io.files.images import image_size, opened
from mover.io.files.npz import read_npy, read_npz
from mover.io.files.schema import Id, Index, Share, Side, Text, checked
from mover.io.masks.coco import CategoryFields
from mover.io.masks.instances import (
    Instance,
    Instances,
    checked_code,
    code_of,
    fitted,
    is_person,
    mask_code,
    objects_tree,
)

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
MASKS = ("masks", "pred_masks", "mask", "segmentation", "arr_0")
TRACKS = ("object_ids", "obj_ids", "track_ids", "track", "person", "ids")
CLASSES = ("labels", "classes", "category", "class_names")
LABELS = "labels.json"
NOT_MASKS = frozenset({"image", "rgb", "input", "reference", "depth"})
"""Names of pictures that lie beside masks."""
MOST_LABELS = 256
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
        pictures = sorted(p for p in path.iterdir() if p.suffix.lower() == ".png")
        if not pictures:
            raise InputError(f"{path}: has no masks, expected pictures (.png)")
        return read_mask_pictures(pictures, path, names, size)
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
    if isinstance(at.value, list):
        return list_instances(at, names, size)
    keys = set(at.value) if isinstance(at.value, dict) else set[str]()
    if "annotations" in keys:
        return coco_instances(at, names, size)
    if "shapes" in keys:
        return labelme_instances(at)
    known = "COCO's 'annotations', labelme's 'shapes' or a list of detections"
    raise InputError(f"{at.file}: has the keys {sorted(keys)[:5]}, expected {known}")


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


def read_mask_arrays(path: Path, names: Names) -> Instances:
    """Masks of an .npz or .npy file.

    `masks` is (n, h, w), (n, 1, h, w) or (frames, objects, h, w), as booleans, bytes or logits
    (above 0 is inside); or (h, w), a label map. Beside it may stand `scores`, `labels` (names),
    `object_ids` and `frame`. With a single object id (n, 1, h, w) is one thing in n frames. Boxes
    are those of the masks.
    """
    npz = path.suffix.lower() == ".npz"
    at = read_npz(path) if npz else At({"masks": read_npy(path).value}, path.name)
    given = _first(at, MASKS)
    if given is None:
        refuse(at, f"an array named {', '.join(MASKS)}", f"the arrays {sorted(at.value)[:6]}")
    stack = given.value
    if not isinstance(stack, np.ndarray) or stack.dtype.kind not in "buif" or stack.ndim < 2:
        refuse(given, "an array of masks (n, h, w), (frames, objects, h, w) or labels (h, w)")
    if stack.ndim == 2 and stack.dtype != np.bool_:
        values = [int(v) for v in np.unique(stack[np.isfinite(stack)]).tolist() if v > 0]
        items = [Instance(names.get(str(v), UNKNOWN), None, code_of(stack == v)) for v in values]
        return Instances(tuple(items), (stack.shape[1], stack.shape[0]), path.name)
    if stack.ndim > 4 or not stack.size:
        refuse(given, "an array of masks (n, h, w) or (frames, objects, h, w)")
    return _of_stack(at, stack, names)


def _of_stack(at: At, stack: NDArray[Any], names: Names) -> Instances:
    """The masks of a stack: of one image, of frames that an array names, or of all frames."""
    ids, frame = _first(at, TRACKS), maybe(at, "frame")
    one_id = ids is not None and isinstance(ids.value, np.ndarray) and ids.value.shape == (1,)
    height, width = stack.shape[-2:]
    flat = stack.reshape(-1, height, width)
    rows, tracks = len(flat), None
    if stack.ndim == 4 and (stack.shape[1] != 1 or (one_id and frame is None)):
        count = stack.shape[1]
        frames = np.repeat(np.arange(len(stack)), count)
        each = np.arange(count) if ids is None else _counted(ids, count)
        tracks = np.tile(each, len(stack))
    else:
        frames = np.zeros(rows, dtype=np.int64) if frame is None else _counted(frame, rows)
        tracks = None if ids is None else _counted(ids, rows)
    words, scores = _first(at, CLASSES), maybe(at, "scores")
    labels, sure = [UNKNOWN] * rows, np.ones(rows)
    if words is not None and isinstance(words.value, np.ndarray) and words.value.dtype.kind == "U":
        labels = [str(word) for word in array(words, (rows,), "text")]
    if scores is not None and isinstance(scores.value, np.ndarray) and scores.value.size == rows:
        sure = np.clip(array(scores, scores.value.shape).reshape(-1), 0, 1)
    found: list[Instance] = []
    for i, pixels in enumerate(flat):
        code, track = code_of(pixels > 0), None if tracks is None else int(tracks[i])
        name = names.get(str(i if track is None else track)) or labels[i]
        if code is not None:
            found.append(Instance(name, None, code, float(sure[i]), int(frames[i]), track))
    return Instances(tuple(found), (width, height), at.file)


def _first(at: At, keys: Sequence[str]) -> At | None:
    """The first of several names of an array that is there."""
    return next((found for key in keys if (found := maybe(at, key)) is not None), None)


def _counted(at: At, rows: int) -> NDArray[np.int64]:
    """Frames or tracks, one a row."""
    value = array(at, (rows,), "whole").astype(np.int64)
    if (value < 0).any() or (value > LAST_INDEX).any():
        refuse(at, f"whole numbers from 0 to {LAST_INDEX}")
    return value


def read_mask_pictures(
    paths: Sequence[Path], source: Path, names: Names, size: Size | None
) -> Instances:
    """Masks of pictures; a category is looked up in labels.json, `names`, then the file name.

    A picture with an alpha channel that is not full is one mask. One with two values is one mask;
    one with more is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are numbers of five digits or more, all label maps, are frames of a video.
    """
    labels = (source if source.is_dir() else source.parent) / LABELS
    table = dict(names)
    if labels.is_file():
        at = read_json(labels)
        words = {key: text(At(value, at.file, key)) for key, value in mapping(at).items()}
        table = words | table
    paths = [p for p in paths if p.stem.lower() not in NOT_MASKS]
    video = len(paths) > 1 and all(re.fullmatch(r"[0-9]{5,8}", p.stem) for p in paths)
    found, sizes = list[Instance](), set[Size]()
    for path in paths:
        pixels = read_labels(path)
        sizes.add((pixels.shape[1], pixels.shape[0]))
        values = [v for v in np.unique(pixels).tolist() if v != 0]
        if len(values) > MOST_LABELS:
            n = f"{len(values)} different values"
            raise InputError(f"{path.name}: has {n}, expected at most {MOST_LABELS} labels")
        if len(values) == 1 and not video:
            parts = re.sub(r"[\d_-]+", " ", path.stem).split()  # `chair` of chair_0, 03_chair
            plain = " ".join(word for word in parts if word.lower() not in ("mask", "masks"))
            name = table.get(path.stem) or plain or UNKNOWN
            found.append(Instance(name, None, code_of(pixels == values[0])))
            continue
        for value in values:
            name, frame = table.get(str(value), UNKNOWN), int(path.stem) if video else 0
            track = value if video else None
            found.append(Instance(name, None, code_of(pixels == value), frame=frame, track=track))
    if len(sizes) > 1:
        raise InputError(f"{source.name}: has pictures of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), sizes.pop() if sizes else size, source.name)


def read_labels(path: Path) -> NDArray[np.int64]:
    """The numbers of a picture of labels (h, w): palette or grey values, or alpha above 0."""
    with opened(path, expected="a picture of masks", bombs="error") as picture:
        if picture.mode in ("RGBA", "LA", "PA"):
            alpha = np.asarray(picture.getchannel("A"))
            if (alpha < 255).any():
                return (alpha > 0).astype(np.int64)
            picture = picture.convert("RGB")
        pixels = np.asarray(picture).astype(np.int64)
    if pixels.ndim == 3:
        pixels = pixels[..., 0] + 256 * pixels[..., 1] + 65536 * pixels[..., 2]
    return pixels
