"""Files of masks: COCO, lists of detections, labelme and others (JSON); pixels: label_images.py."""

import dataclasses
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from mover.core.errors import InputError
from mover.core.files import PICKLES
from mover.io.capture.parts import UNKNOWN, Hints, Parts
from mover.io.files.fields import FASTEST, LAST_INDEX, SLOWEST, At, read_json
from mover.io.files.images import image_size
from mover.io.files.schema import Id, Index, Share, Side, Text, checked
from mover.io.masks.coco import COCO_CLASSES, COCO_IDS, MOST_THINGS, CategoryFields, is_drawn
from mover.io.masks.instances import (
    Instance,
    Instances,
    Names,
    Size,
    code_in,
    frames_of,
    labelme_instances,
    mask_code,
)
from mover.io.masks.label_images import PICTURES, pictures_in, read_label_images, read_mask_arrays
from mover.io.people.values import lone, natural, number_in

LEAST_SCORE = 0.3  # of MMDetection, which writes everything that it thought of
EXPORTS = {
    "Label Studio's JSON": "COCO (polygons) or 'Brush labels to PNG'",
    "CVAT's XML": "'COCO 1.0' or 'Segmentation mask 1.1'",
    "an XML of Pascal VOC": "COCO, which has masks",
    "YOLO's text": "COCO: it has no names and no size of the image",
    "a project of VIA": "COCO (Annotation, Export)",
    "a table": "COCO (of VIA: Annotation, Export)",
    "an archive": "the files in it: unpack it",
    "COCO's panoptic JSON": "COCO of instances, or its PNG as labels",
    "Roboflow's predictions": "COCO segmentation",
}
"""What is not read, and what to export in its place."""
LABEL_STUDIO = {"completions", "annotation_id", "lead_time", "annotator"}  # keys of a task
FOREIGN = {
    ".xml": "an XML of Pascal VOC", ".txt": "YOLO's text", ".zip": "an archive",
    ".csv": "a table",
}  # fmt: skip
"""What files of other kinds are."""


def mask_parts(source: Path, hints: Hints) -> Parts:
    """The objects of a file of masks."""
    size, picture, camera = None, "", {} if hints.camera is None else hints.camera.value
    if hints.image is not None:
        size, picture = image_size(hints.image), hints.image.name
    elif camera.get("w") and camera.get("h"):
        size = camera["w"], camera["h"]
    found = read_things(source, hints.names, size, picture)
    return Parts(name=source.stem, objects=found.objects_tree(), notes=found.notes)


def read_things(
    path: Path,
    names: Names,
    size: Size | None,
    picture: str = "",
    *,
    fit: Size | None = None,
    people: bool = False,
) -> Instances:
    """What is seen in one picture, furniture or people, at the size `fit`.

    Of several pictures that of the name or with the number of `picture` counts.
    """
    found = read_instances(path, names, size, picture=picture)
    frames, kept, notes = sorted({item.frame for item in found.items}), found.items, found.notes
    if len(frames) > 1:
        wanted = number_in(Path(picture).stem, -1)
        if wanted not in frames:
            few = ", ".join(map(str, frames[:4]))
            raise InputError(
                f"{path.name}: has things in {len(frames)} images ({few} ...), expected those of "
                f"{picture or 'the reference picture: give --image'}"
            )
        kept = tuple(item for item in kept if item.frame == wanted)
        said = f"{path.name}: of {len(frames)} images that with the number of {picture} is taken"
        notes = (*notes, said)
    else:  # which frame it is does not matter
        notes = tuple(note for note in notes if "frame" not in note)
    found = dataclasses.replace(found, items=kept, notes=notes).fitted(fit or size)
    if people:
        return found.people()
    kept, notes = tuple(item for item in found.items if not item.is_person), found.notes
    if bare := sum(item.category == UNKNOWN for item in kept):
        notes += (f"{path.name}: masks without category: {bare} of {len(kept)} (--names 1=chair)",)
    if people_left := len(found.items) - len(kept):
        notes += (f"{path.name}: masks of people left out: {people_left} (--reference-people)",)
    return dataclasses.replace(found, items=kept, notes=notes)


def read_people(path: Path, names: Names, size: Size | None, fit: Size | None = None) -> Instances:
    """The people in the frames of a video, each in a track, in images of the size `fit`."""
    found = read_instances(path, names, size, people=True)
    return found.fitted(fit or size).people().followed()


def read_instances(
    path: Path, names: Names, size: Size | None, *, people: bool = False, picture: str | None = None
) -> Instances:
    """The instances of a .json, .npz, .npy, .pkl or picture of masks, or of a folder of such.

    Args:
        path: The file or folder.
        names: Categories where the source has none.
        size: Width and height of the image, for sources without it [px].
        people: Whether people in frames are looked for.
        picture: The file name of the only picture that counts; None: all do.
    """
    if path.is_dir():
        return _of_folder(path, names, size, people=people, picture=picture)
    kind = path.suffix.lower()
    if kind in (".npz", ".npy", *PICKLES):
        return read_mask_arrays(path, names, people=people)
    if kind in PICTURES:
        return read_label_images([path], path, names, people=people)
    if kind == ".json":
        return _of_json(read_json(path), names, size, picture)
    head = path.read_bytes()[:2000] if path.is_file() else b""
    found = FOREIGN.get(kind)
    found = "CVAT's XML" if kind == ".xml" and b"<annotations" in head else found
    if kind == ".txt" and not re.match(rb"\s*\d+(\s+[\d.]+){4}", head):
        found = None
    if found and head:
        raise InputError(f"{path}: is {found}, expected {EXPORTS[found]}")
    kinds = ".json, .npz, .npy, .pkl, .png or a folder of pictures"
    raise InputError(f"{path}: is no file of masks, expected {kinds}")


def _of_folder(
    path: Path, names: Names, size: Size | None, *, people: bool, picture: str | None
) -> Instances:
    """A folder of pictures, of arrays, of folders of those, or of JSON files."""
    if (path / "mask_data").is_dir():
        path = path / "mask_data"
    homes = [path] if pictures_in(path) else [p for p in path.iterdir() if p.is_dir()]
    if found := [file for home in homes for file in pictures_in(home)]:
        return read_label_images(found, path, names, people=people)
    files = sorted(path.glob("*.json"), key=natural) or sorted(path.glob("*.npz"), key=natural)
    stem = Path(picture or "").stem.lower()
    ours = [file for file in files if file.stem.lower() == stem] if len(files) > 1 else []
    if ours:
        found = read_instances(ours[0], names, size, people=people, picture=picture)
        said = f"{path.name}: of {len(files)} files only {ours[0].name} is taken"
        return dataclasses.replace(found, notes=(said, *found.notes))
    for file in sorted(path.iterdir()) if not files else ():
        if file.suffix.lower() in FOREIGN:
            return read_instances(file, names, size)
    if not files:
        raise InputError(f"{path}: has no masks, expected pictures (.png), .npy, .npz or .json")
    lone = people and len(files) == 1
    parts = [read_instances(f, names, size, people=lone, picture=picture) for f in files]
    many = [part.file for part in parts if len({item.frame for item in part.items}) > 1]
    if many and len(files) == 1:
        return parts[0]
    if many:
        found = f"has {len(files)} files, of which {many[0]} has several frames"
        raise InputError(f"{path.name}: {found}, expected a frame in each file, or one file")
    numbers = [number_in(file.stem, rank) for rank, file in enumerate(files)]
    frames, notes = frames_of(numbers, f"{path.name}: numbers")
    sizes = {part.size for part in parts if part.size is not None}
    if len(sizes) > 1:
        raise InputError(f"{path.name}: has images of {len(sizes)} sizes, expected one")
    rows = tuple(
        dataclasses.replace(item, frame=frames[number])
        for part, number in zip(parts, numbers, strict=True) for item in part.items
    )  # fmt: skip
    notes += tuple(dict.fromkeys(note for part in parts for note in part.notes))
    looked = frozenset(frames.values())
    return Instances(rows, next(iter(sizes), size), path.name, looked, notes)


def _of_json(at: At, names: Names, size: Size | None, picture: str | None) -> Instances:
    """JSON, by its keys."""
    rows = at.value if isinstance(at.value, list) else [at.value]
    keys = [set(row) if isinstance(row, dict) else set[str]() for row in rows]
    inner = at.value.values() if isinstance(at.value, dict) else ()
    foreign = {
        "Label Studio's JSON": any(k & LABEL_STUDIO for k in keys)
        or any("data" in k and k & {"annotations", "predictions"} for k in keys),
        "a project of VIA": any("_via_img_metadata" in one for one in keys)
        or any(isinstance(row, dict) and "regions" in row for row in inner),
        "COCO's panoptic JSON": "segments_info" in str(at.value)[:100_000],
        "Roboflow's predictions": {"predictions", "image"} <= keys[0] if keys else False,
    }
    for found in (name for name, seen in foreign.items() if seen):
        raise InputError(f"{at.file}: is {found}, expected its export as {EXPORTS[found]}")
    if keys and all({"labels", "scores"} <= k or "predictions" in k for k in keys):
        return _of_mmdet(at, names, size)
    if isinstance(at.value, list):
        return list_instances(at, names, size)
    (have,) = keys
    if have & {"box_format", "img_width"}:
        return coco_instances(_of_grounded_sam(at), names, size, picture)
    if "annotations" in have and "image" in have - {"images"} and "images" not in have:  # SA-1B
        rows = [{**row.mapping(), "image_id": 0} for row in at.get("annotations").items()]
        tree = {"images": [{**at.get("image").mapping(), "id": 0}], "annotations": rows}
        return coco_instances(at.holding(tree), names, size, picture)
    if {"annotations", "images"} <= have:
        return coco_instances(at, names, size, picture)
    if "shapes" in have:
        return labelme_instances(at)
    if "mask_name" in have:
        raise InputError(f"{at.file}: has no masks, expected the folder mask_data beside json_data")
    known = "COCO's 'images' and 'annotations', labelme's 'shapes' or a list of detections"
    raise InputError(f"{at.file}: has the keys {sorted(have)[:5]}, expected {known}")


class ImageFields(Struct, frozen=True):
    """One of COCO's `images`."""

    id: Id
    width: Side | None = None
    height: Side | None = None
    file_name: Any = None

    @property
    def size(self) -> Size | None:
        """Its own [px]."""
        return (self.width, self.height) if self.width and self.height else None

    @property
    def stem(self) -> str:
        """The name of its file without folders and ending."""
        return Path(str(self.file_name or "").replace("\\", "/")).stem


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
    attributes: Any = None

    @property
    def track(self) -> int | None:
        """Where CVAT keeps it, if it is not with the rest."""
        own = self.attributes.get("track_id") if isinstance(self.attributes, dict) else None
        return own if self.track_id is None and type(own) is int and own >= 0 else self.track_id


def coco_instances(
    at: At, names: Names, size: Size | None, picture: str | None = None
) -> Instances:
    """The annotations of a COCO file; frames are the numbers in its file names, else its ids.

    With `picture` only that image counts, and where no name is its, the only one with annotations.
    """
    listed = [(item, checked(item, ImageFields)) for item in at.get("images").items()]
    rows = [(item, checked(item, RowFields)) for item in at.get("annotations").items()]
    given, known = at.maybe("categories"), {image.id for _, image in listed}
    words = dict(zip(COCO_IDS, COCO_CLASSES, strict=True))
    if given is not None:
        words = {row.id: str(row.name) for row in checked(given, list[CategoryFields])}
    words |= {int(key): name for key, name in names.items() if key.isdecimal()}
    for item, row in rows:
        if row.image_id not in known:
            item.get("image_id").refuse("the id of one of the images")
        if row.category_id is not None and row.category_id not in words:
            item.get("category_id").refuse("the id of one of the categories")
        if row.bbox is None and not is_drawn(row.segmentation):
            item.refuse("an annotation with bbox or segmentation")
    notes: tuple[str, ...] = ()
    if picture is not None and len(listed) > 1:
        used = {row.image_id for _, row in rows}
        ours = _ours([image for _, image in listed], used, picture, size, at.file)
        notes = (f"{at.file}: of {len(listed)} images only {ours.file_name or ours.id} is taken",)
        listed = [(item, image) for item, image in listed if image.id == ours.id]
        rows = [(item, row) for item, row in rows if row.image_id == ours.id]
    elif picture and listed and listed[0][1].stem.lower() not in ("", Path(picture).stem.lower()):
        notes = (f"{at.file}: its only image, {listed[0][1].file_name}, is taken for {picture}",)
    if picture is not None and len(rows) > MOST_THINGS:
        at.get("annotations").refuse(f"at most {MOST_THINGS} in a picture", f"{len(rows)} items")
    need = "width and height, here or by --image"
    sizes = {i.id: i.size or size or item.refuse(need) for item, i in listed}
    tracked = any(row.track is not None for _, row in rows)
    frames, more = _frames_of_images([image for _, image in listed], at.file, tracked=tracked)
    found = [_instance(item, row, sizes[row.image_id or 0], words, frames) for item, row in rows]
    if len(set(sizes.values())) > 1:
        at.get("images").refuse("images of one size", f"{len(set(sizes.values()))} sizes")
    looked, own = frozenset(frames.values()), next(iter(sizes.values()), size)
    info = at.maybe("info")
    rate = info.maybe("fps") if info is not None and isinstance(info.value, dict) else None
    fps = None if rate is None else rate.number(SLOWEST, FASTEST)
    return Instances(tuple(found), own, at.file, looked, (*notes, *more), fps)


def _ours(
    images: Sequence[ImageFields], used: set[int | None], picture: str, size: Size | None, file: str
) -> ImageFields:
    """The one image of a file that is the reference picture."""
    stem = Path(picture or "reference.jpg").stem.lower()
    named = [i for i in images if i.stem.lower() == stem]
    full = [i for i in images if i.id in used]
    fits = [i for i in full if size is None or (i.width, i.height) in (size, (None, None))]
    for group in (named, full, fits):
        if len(group) == 1:
            return group[0]
    few = ", ".join(str(i.file_name or i.id) for i in images[:4])
    wanted = picture or "reference.jpg, or the name of --image"
    raise InputError(f"{file}: has {len(images)} images ({few} ...), expected one called {wanted}")


def _frames_of_images(
    images: Sequence[ImageFields], file: str, *, tracked: bool
) -> tuple[dict[int, int], tuple[str, ...]]:
    """Frames by the ids of images. In files of this program ids of tracked people are frames."""
    stems = [image.stem for image in images]
    numbers = {i.id: number_in(s, -1) for i, s in zip(images, stems, strict=True)}
    plain = {s.rstrip("0123456789") for s in stems}
    if -1 in numbers.values() or len(set(numbers.values())) < len(images) or len(plain) > 1:
        if tracked and all(i.id <= LAST_INDEX and not i.file_name for i in images):
            return {image.id: image.id for image in images}, ()
        numbers, what = {image.id: image.id for image in images}, "ids of images"
    else:
        what = "numbers of images"
    frames, notes = frames_of(list(numbers.values()), f"{file}: {what}")
    return {key: frames[value] for key, value in numbers.items()}, notes


def list_instances(at: At, names: Names, size: Size | None) -> Instances:
    """A list of detections: COCO's results, or those of MOVER with rows of pixels.

    An item has `class` (a name) or `category_id`; `bbox` and `segmentation` or `mask`. COCO's ids
    have gaps; a file whose ids only make sense counted from 0 is read so. Frames are image_ids.
    """
    if at.value and all(isinstance(image, list) for image in at.value):  # a list an image
        images = enumerate(at.items())
        at = at.holding([{**one.mapping(), "image_id": k} for k, i in images for one in i.items()])
    if any(isinstance(row, dict) and "box" in row for row in at.value):
        at = _of_ultralytics(at)
    rows = [(item, checked(item, RowFields)) for item in at.items()]
    for item, row in rows:
        if row.bbox is None and row.mask is None and not is_drawn(row.segmentation):
            item.refuse("a detection with bbox, segmentation or mask")
    keys = {row.category_id for _, row in rows if row.category_id is not None}
    contiguous = not keys <= set(COCO_IDS) and max(keys) < len(COCO_CLASSES)
    table = enumerate(COCO_CLASSES) if contiguous else zip(COCO_IDS, COCO_CLASSES, strict=True)
    words = dict(table) | {int(key): name for key, name in names.items() if key.isdecimal()}
    images = [row.image_id for _, row in rows if row.image_id is not None]
    frames, notes = frames_of(images, f"{at.file}: image_ids")
    found: list[Instance] = []
    for item, row in rows:
        given = _drawn(item, row)
        size = _size_of(given) if given is not None and isinstance(given.value, dict) else size
        found.append(_instance(item, row, size, words, frames))
    return Instances(tuple(found), size, at.file, frozenset(frames.values()), notes)


def _of_ultralytics(at: At) -> At:
    """Rows of Ultralytics' `to_json` as detections with names, corners and polygons."""
    rows: list[dict[str, Any]] = []
    for row in at.items():
        box, outline = row.get("box"), row.maybe("segments")
        corners = [box.get(key).number() for key in ("x1", "y1", "x2", "y2")]
        new: dict[str, Any] = {"class": row.get("name").text(), "bbox": corners}
        keys = {"score": "confidence", "track_id": "track_id", "image_id": "image_id"}
        new |= {ours: row.value.get(theirs) for ours, theirs in keys.items()}
        if outline is not None:
            x, y = (outline.get(axis).items() for axis in "xy")
            new["segmentation"] = [[v.value for pair in zip(x, y, strict=False) for v in pair]]
        rows.append(new)
    return at.holding(rows)


def _instance(
    at: At, row: RowFields, size: Size | None, words: Mapping[int, str], frames: Mapping[int, int]
) -> Instance:
    """One row. MOVER's boxes are corners with the score behind, COCO's have width and height."""
    box, score = None, row.score
    if row.bbox is not None and len(row.bbox) == 5 and row.category_id is None:
        *box, last = at.get("bbox").vector(5)
        score = At(last, at.file, f"{at.field}.bbox").number(0, 1) if score is None else score
    elif row.bbox is not None:
        box = _corners(at.get("bbox"), sized=row.name is None)
        if 0 < max(box) <= 1 and row.mask is None and not is_drawn(row.segmentation):
            at.get("bbox").refuse("pixels", "a box from 0 to 1")
    key = -1 if row.category_id is None else row.category_id
    return Instance(
        category=words.get(key, UNKNOWN) if row.name is None else str(row.name),
        box=None if box is None else tuple(box), mask=code_in(_drawn(at, row), size),
        score=1.0 if score is None else score,
        frame=0 if row.image_id is None else frames[row.image_id], track=row.track,
    )  # fmt: skip


def _drawn(at: At, row: RowFields) -> At | None:
    """What a row has as its mask: rows of pixels as their code, polygons, or a code."""
    if not isinstance(row.mask, list):
        return at.maybe("segmentation")
    return At(mask_code(at.get("mask")), at.file, f"{at.field}.mask")


def _size_of(code: At) -> Size:
    """Width and height of a run-length code [px]."""
    height, width = checked(code.get("size"), tuple[Side, Side])
    return width, height


def _corners(at: At, *, sized: bool) -> tuple[float, ...]:
    """The corners of a box, which may be given by its width and height."""
    a, b, c, d = at.vector(4)
    return (a, b, a + c, b + d) if sized else (a, b, c, d)


def _of_grounded_sam(at: At) -> At:
    """The results of Grounded-SAM-2's demos of a picture, with DUMP_JSON_RESULTS, as COCO's."""
    sized = at.get("box_format").choice(("xyxy", "xywh")) == "xywh"
    rows: list[dict[str, Any]] = []
    for item in at.get("annotations").items():
        name, box, score = item.get("class_name"), item.maybe("bbox"), item.maybe("score")
        sure = 1.0 if score is None else score.holding(lone(score)).number(0, 2)
        row = {"class": UNKNOWN if name.value == "" else name.text(), "image_id": 0}
        row |= {"score": min(sure, 1.0)}  # SAM 2's may be above 1
        row |= {} if box is None else {"bbox": _corners(box, sized=sized)}
        rows.append({**row, "segmentation": item.get("segmentation").value})
    image = {"id": 0, "width": at.get("img_width").value, "height": at.get("img_height").value}
    return at.holding({"images": [image], "annotations": rows})


def _of_mmdet(at: At, names: Names, size: Size | None) -> Instances:
    """Predictions of MMDetection's DetInferencer, of one picture or one for each frame."""
    every = at.items() if isinstance(at.value, list) else [at]
    inner = [(one, one.maybe("predictions")) for one in every]
    entries = [item for one, held in inner for item in (held.items() if held else [one])]
    drawn = (m for one in entries if (masks := one.maybe("masks")) for m in masks.items())
    size = _size_of(mask) if (mask := next(drawn, None)) is not None else size
    rows = [row for k, one in enumerate(entries) for row in _predictions(one, k, names, size)]
    found = tuple(row for row in rows if row is not None)
    low = f"detections with scores below {LEAST_SCORE} left out: {rows.count(None)} of {len(rows)}"
    several = f"{len(entries)} entries of MMDetection are frames in their order"
    said = {low: len(rows) > len(found), several: len(entries) > 1}
    notes = tuple(f"{at.file}: {text}" for text, holds in said.items() if holds)
    return Instances(found, size, at.file, frozenset(range(len(entries))), notes)


def _predictions(at: At, frame: int, names: Names, size: Size | None) -> Iterator[Instance | None]:
    """One entry, lists of labels, scores, bboxes and masks; None for what has a low score."""
    labels, boxes, masks = at.get("labels"), at.maybe("bboxes"), at.maybe("masks")
    scores, keys = at.get("scores").items(), checked(labels, list[Id])
    table = {str(k): name for k, name in enumerate(COCO_CLASSES)} | dict(names)
    if len({len(keys), len(scores), *(len(one.items()) for one in (boxes, masks) if one)}) > 1:
        labels.refuse(f"as many as scores, bboxes and masks ({len(scores)})", f"{len(keys)} items")
    for k, key in enumerate(keys):
        if (score := scores[k].number(0, 1)) < LEAST_SCORE:
            yield None
            continue
        if str(key) not in table:
            labels.items()[k].refuse(f"a class of COCO, 0 to {len(COCO_CLASSES) - 1}, or --names")
        box = None if boxes is None else tuple(boxes.items()[k].vector(4))
        mask = code_in(None if masks is None else masks.items()[k], size)
        yield Instance(table[str(key)], box, mask, score, frame)
