"""Masks as pixels: pictures, arrays and dumps of SAM 2, of one image or of frames of a video."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.pickles import LARGEST
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import At, read_json, read_npy, read_npz
from mover.io.files.images import opened
from mover.io.masks.instances import Instance, Instances, Names, Size, code_of, frames_of
from mover.io.people.values import natural, number_in, read_any

MASKS = ("masks", "pred_masks", "mask", "segmentation", "arr_0")
TRACKS = ("object_ids", "obj_ids", "track_ids", "track", "person", "ids")
CLASSES = ("labels", "classes", "category", "class_names")
LABELS = "labels.json"
NOT_MASKS = frozenset({"image", "img", "rgb", "input", "reference", "depth", "photo"})
"""Names of pictures that lie beside masks."""
PICTURES = (".png", ".bmp", ".tif", ".tiff", ".gif", ".webp", ".jpg", ".jpeg")
LOSSY = (".jpg", ".jpeg", ".webp")
FRAME_WORDS = frozenset(
    {"", "frame", "frames", "f", "img", "im", "image", "images", "rgb", "color", "colour", "mask"}
    | {"masks", "video", "seg", "segmentation", "output", "out", "cam", "camera", "label"}
)
"""What stands before the number of a frame."""
MOST_LABELS = 256
FEW = 16  # so few small values are labels
WHITE = (255, 65535, 0xFFFFFF)
NEAR = 8  # values so near to black or white are black or white, where a mask is soft
PHOTO = 0.3  # share of the pixels that are neither dark nor bright, which masks have not
SAME = 0.5  # overlap of the same person in two frames that follow each other
Row = tuple[NDArray[Any], Instance]
"""The pixels of a thing, and the thing without its mask."""


def read_label_images(
    paths: Sequence[Path], source: Path, names: Names, *, people: bool = False
) -> Instances:
    """Masks of pictures and of arrays of labels (.npy).

    A category is looked up in labels.json, `names`, then the file name. A picture with an alpha
    channel that is not full, or with one value beside black, is one mask, soft rims or not; one
    with more values is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are the numbers of frames are a video, in which a label is a track. In a folder of folders
    each is one object of a video (SAM 2's), or a frame (00000/0.png, as 00000_0.png). `source` is
    the folder or file that the user named; of `people`, frames may have short numbers, too.
    """
    home = source if source.is_dir() else source.parent
    beside = read_json(home / LABELS) if (home / LABELS).is_file() else At({}, LABELS)
    table = {**{key: beside.get(key).text() for key in beside.mapping()}, **names}
    if source.is_dir():
        paths = sorted((p for p in paths if p.stem.lower() not in NOT_MASKS), key=natural)
    owners, framed, how = _things_and_frames(paths, source)
    apart, ranks = bool(owners), list(dict.fromkeys(owners))
    numbers = _numbers_of(framed, people=people or apart)
    if apart and numbers is None:
        bare = next((p.name for p in paths if not re.search(r"\d", p.stem)), paths[0].name)
        raise InputError(f"{bare}: has no number of a frame in its name")
    frames, notes = frames_of(list((numbers or {}).values()), f"{source.name}: numbers")
    notes += (f"{source.name}: {how}",) if how else ()

    def rows() -> Iterator[Row]:
        for k, path in enumerate(paths):
            frame = None if numbers is None else frames[numbers[framed[k]]]
            if apart:
                name = names.get(owners[k]) or _word_of(owners[k]) or UNKNOWN
                track = number_in(owners[k], ranks.index(owners[k]))
                yield _labels_of(path) > 0, Instance(name, None, None, 1.0, frame or 0, track)
            else:
                yield from _labelled(path, {**_classes_beside(path), **table}, frame)

    found = _gathered(rows(), source.name, "pictures", frames.values())
    tracks = {item.track for item in found.items}
    if numbers is not None and not apart and len(tracks) == 1 and tracks <= set(WHITE):
        found = replace(found, items=tuple(replace(item, track=0) for item in found.items))
        notes = (*notes, f"{source.name}: white masks are one person or thing in all frames")
    if people and numbers is None and len(paths) > 1:
        how = "pictures are people of one image; those of frames are named by numbers: 000000.png"
        notes = (*notes, f"{source.name}: {how}")
    return replace(found, notes=notes)


def _things_and_frames(paths: Sequence[Path], source: Path) -> tuple[list[str], list[str], str]:
    """Names of the thing (none: it has no name) and of the frame of each picture, and a note."""
    stems, folders = [path.stem for path in paths], [path.parent.name for path in paths]
    if not source.is_dir() or any(path.parent == source for path in paths):
        pairs = [re.fullmatch(r"(\D*\d{3,})[_-](\D*\d{1,2})", stem) for stem in stems]
        found = [pair for pair in pairs if pair is not None]
        framed = [pair[1] for pair in found]
        if len(found) < len(paths) or not _are_frames(framed):
            return [], stems, ""
        said = f"names like {stems[0]} are of a frame and of a person or thing in it"
        return [pair[2] for pair in found], framed, said
    short, long = (min(len(re.sub(r"\D", "", s)) for s in some) for some in (stems, folders))
    objects = (long, len(set(folders))) <= (short, len(set(stems)))
    if objects or not _are_frames(folders) or len(set(stems)) == len(stems):
        return folders, stems, ""
    return stems, folders, f"folders like {folders[0]} are frames, with the people or things in it"


def _are_frames(names: list[str]) -> bool:
    """Whether names are numbers, alone or behind words for frames."""
    words = set(re.split(r"[\W_\d]+", " ".join(names).lower()))
    return words <= FRAME_WORDS and _numbers_of(names, people=True) is not None


def _labelled(path: Path, words: Names, frame: int | None) -> Iterator[Row]:
    """Each label of a picture; without a frame, a picture of one label is called by its file."""
    pixels = _labels_of(path)
    labels = _labels_in(At(pixels, path.name))
    lone = frame is None and len(labels) == 1 and path.suffix.lower() != ".npy"
    for label in labels:
        said = words.get(path.stem) or _word_of(path.stem) if lone else words.get(str(label))
        track = None if frame is None else label
        yield pixels == label, Instance(said or UNKNOWN, None, None, 1.0, frame or 0, track)
    if not labels:  # an empty picture has a size
        yield pixels > 0, Instance(UNKNOWN, None, None)


def _labels_in(at: At) -> list[int]:
    """The numbers of things in an array of labels."""
    labels = [int(v) for v in np.unique(at.value[np.isfinite(at.value)]).tolist() if v > 0]
    if len(labels) > MOST_LABELS:
        at.refuse(f"at most {MOST_LABELS} labels", f"{len(labels)} different values")
    return labels


def _gathered(
    rows: Iterable[Row], file: str, what: str, frames: Iterable[int], notes: tuple[str, ...] = ()
) -> Instances:
    """Things and their masks of one size, without the empty ones."""
    found, sizes = list[Instance](), set[Size]()
    for pixels, item in rows:
        sizes.add((pixels.shape[1], pixels.shape[0]))
        if (code := code_of(pixels)) is not None:
            found.append(replace(item, mask=code))
    if len(sizes) > 1:
        raise InputError(f"{file}: has {what} of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), next(iter(sizes), None), file, frozenset(frames), notes)


def pictures_in(folder: Path) -> list[Path]:
    """Pictures of masks in a folder, of one kind: those without loss before others."""
    for kinds in ((".npy",), (".png",), PICTURES):
        found = [p for p in folder.iterdir() if p.suffix.lower() in kinds]
        if any(p.stem.lower() not in NOT_MASKS for p in found):
            return found
    return []


def _classes_beside(path: Path) -> dict[str, str]:
    """Names of labels of mask_data/mask_0.npy in json_data/mask_0.json, as Grounded-SAM-2 has."""
    file = path.parent.parent / "json_data" / f"{path.stem}.json"
    if path.suffix.lower() != ".npy" or not file.is_file():
        return {}
    given = read_json(file).get("labels").value
    rows = given.values() if isinstance(given, Mapping) else given
    found = [At(row, file.name, f"labels[{k}]") for k, row in enumerate(rows)]
    return {str(row.get("instance_id").integer()): row.get("class_name").text() for row in found}


def _word_of(stem: str) -> str:
    """`chair` of chair_0, 03_chair."""
    words = re.sub(r"[\d_-]+", " ", stem).split()
    return " ".join(word for word in words if word.lower() not in ("mask", "masks"))


def _numbers_of(stems: Sequence[str], *, people: bool) -> dict[str, int] | None:
    """The numbers of frames in the names of files; None: they are no frames.

    Furniture and people of one image are numbered as well (0.png, person_1.png): numbers of frames
    are longer, or stand behind `frame`, or alone where people are looked for.
    """
    found = {stem: re.fullmatch(r"(.*?)(\d+)(\D*)", stem) for stem in stems}
    parts = [match for match in found.values() if match is not None]
    around = {(match[1].lower(), match[3].lower()) for match in parts}
    if len(parts) < len(found) or len(around) != 1:
        return None
    words = set(re.split(r"[\W_\d]+", " ".join(next(iter(around)))))
    length = min(len(match[2]) for match in parts)
    if people:
        framed = (words <= FRAME_WORDS and (len(found) > 1 or length >= 3)) or length >= 3
    else:
        framed = "frame" in words or (length >= 5 and len(found) > 1)
    return {stem: int(match[2]) for stem, match in found.items() if match} if framed else None


def _labels_of(path: Path) -> NDArray[np.int64]:
    """Labels (h, w), 0 for nothing, of an array, or the values, colours or alpha of a picture."""
    kind = path.suffix.lower()
    if kind == ".npy":
        value = np.squeeze(read_npy(path).value)
        if value.ndim != 2 or value.dtype.kind not in "bui":
            At(value, path.name).refuse("an array of labels (h, w)")
        return value.astype(np.int64)
    with opened(path, expected="a picture of masks", bombs="error") as picture:
        drawn = picture.mode == "P"
        if picture.mode in ("RGBA", "LA", "PA"):
            alpha = np.asarray(picture.getchannel("A"))
            if (alpha < 255).any():
                return (alpha >= 128 if alpha.max() >= 128 else alpha > 0).astype(np.int64)
            picture = picture.convert("RGB")
        pixels = np.asarray(picture).astype(np.int64)
    if pixels.ndim == 3:
        grey = (pixels[..., :1] == pixels).all()
        weights = [1, 0, 0] if grey or kind in LOSSY else [1, 256, 65536]
        pixels = pixels[..., :3] @ weights
    return pixels if drawn else _hardened(pixels, path.name, lossy=kind in LOSSY)


def _hardened(pixels: NDArray[np.int64], name: str, *, lossy: bool) -> NDArray[np.int64]:
    """Labels without the grey rims of soft or resized masks: values that fill no area are rims."""
    values = np.unique(pixels)
    most = int(values[-1])
    if len(values) <= 2 or (most < 200 and len(values) < FEW):
        return pixels
    if most in WHITE[:2]:
        near = NEAR * most // 255
        clean = np.where(pixels <= near, 0, np.where(pixels >= most - near, most, pixels))
    else:
        clean = pixels
    same = np.ones_like(pixels, dtype=bool)
    for whole, flags in ((clean, same), (clean.T, same.T)):
        equal = np.diff(whole, axis=0) == 0
        flags[1:] &= equal
        flags[:-1] &= equal
    solid, counts = np.unique(clean[same & (clean > 0)], return_counts=True)
    between = np.unique(clean[(clean > 0) & (clean < most)])
    inner = counts[solid < most].sum()
    soft = most in WHITE[:2] and len(between) > 1 and inner <= 0.1 * max(1, counts.sum())
    photo = (np.abs(pixels - most / 2) < 0.3 * most).mean() > PHOTO
    if photo and (lossy or len(between) > MOST_LABELS):
        raise InputError(f"{name}: has {len(values)} values, as a photo, expected a mask or labels")
    if lossy or soft:
        return np.where(pixels > most // 2, most, 0)
    if len(between) > 2 * len(solid):
        return np.where(np.isin(clean, solid), clean, 0)
    return pixels


def read_mask_arrays(path: Path, names: Names, *, people: bool = False) -> Instances:
    """Masks of an .npz, an .npy or a pickle.

    `masks` is (n, h, w), (n, 1, h, w), (frames, objects, h, w) or (objects, frames, h, w), as
    booleans, bytes, probabilities (from 0 to 1, cut at .5) or logits (above 0 is inside); or a
    label map of whole numbers, (h, w), or one for each frame, in which a label is a track. Beside
    it may stand `scores`, `labels` (names), `object_ids` and `frame`. With a single object id
    (n, 1, h, w) is one thing in n frames, and so is that of people without ids, as are n masks of
    people that lie on each other. Boxes are those of the masks. A pickle, or the .npy of a mapping,
    may also be what SAM 2's video predictor gives: {frame: {object: mask}}.
    """
    npz = path.suffix.lower() == ".npz"
    at, notes = read_npz(path, LARGEST) if npz else read_any(path), list[str]()
    if isinstance(at.value, np.ndarray):
        at = at.holding({"masks": at.value})
    if isinstance(at.value, list) and "'pred_instances'" in str(at.value)[:1000]:
        found = "MMDetection's dump of a test ('pred_instances')"
        at.refuse("masks: DetInferencer's preds/<image>.json (out_dir) has them", found)
    at = at.maybe("video_segments") or at
    frames = [(key, at.get(key)) for key in at.mapping()]
    if frames and all(key.isdecimal() and isinstance(at.value, Mapping) for key, at in frames):
        rows = [row for key, at in frames for row in _segments(int(key), at, names, notes)]
        if not rows:
            at.refuse("masks of objects in frames")
        said = tuple(dict.fromkeys(notes))
        return _gathered(rows, path.name, "masks", (int(key) for key, _ in frames), said)
    given = at.maybe(*MASKS)
    if given is None:
        at.refuse(f"an array named {', '.join(MASKS)}", ", ".join(sorted(at.value)[:6]) or "none")
    stack = _stack_of(at, given, notes)
    flat, size = stack.reshape(-1, *stack.shape[-2:]), (stack.shape[-1], stack.shape[-2])
    if stack.dtype == np.bool_ or (stack.ndim > 2 and not _are_maps(stack)):
        found = _of_stack(at, stack, names, people=people)
        return replace(found, notes=(*notes, *found.notes))
    frame = at.maybe("frame")
    numbers = range(len(flat)) if frame is None else frame.indices(len(flat)).tolist()
    rows = (
        (pixels == v, Instance(names.get(str(v), UNKNOWN), None, None, 1.0, number, v))
        for number, pixels in zip(numbers, flat, strict=True)
        for v in _labels_in(given.holding(pixels))
    )
    return replace(_gathered(rows, at.file, "masks", () if stack.ndim == 2 else numbers), size=size)


def _stack_of(at: At, given: At, notes: list[str]) -> NDArray[Any]:
    """Masks or labels, cut: those of frames first, then of objects, the picture's axes behind."""
    stack = given.value
    known = isinstance(stack, np.ndarray) and stack.dtype.kind in "buif" and stack.size
    if not known or not 2 <= stack.ndim <= 4:
        given.refuse("an array of masks (n, h, w), (frames, objects, h, w) or labels (h, w)")
    if stack.ndim == 4 and stack.shape[-1] == 1:
        stack = np.moveaxis(stack, -1, 1)  # (frames, h, w, 1)
    several = stack.ndim == 4 and 1 not in stack.shape[:2]
    stack = _cut(given, stack, notes)
    return _frames_first(at, stack, notes) if several else stack


def _cut(at: At, value: NDArray[Any], notes: list[str]) -> NDArray[Any]:
    """Booleans, or whole numbers: logits are cut at 0, probabilities and grey values at half."""
    if value.dtype == np.bool_:
        return value
    known = value[np.isfinite(value)] if value.dtype.kind == "f" else value
    low, top = float(known.min(initial=0)), float(known.max(initial=0))
    if low < 0:
        return value > 0
    if value.dtype.kind == "f":
        if (known % 1).any():
            if top <= 1:
                notes.append(f"{at.file}: numbers from 0 to 1 are probabilities, cut at 0.5")
            return value > top / 2 if top > 1 else value > 0.5
        value = np.nan_to_num(value, posinf=0).astype(np.int64)
    flat = value.reshape(-1, *value.shape[-2:])

    def hard(pixels: NDArray[Any]) -> NDArray[np.int64]:
        return _hardened(pixels.astype(np.int64), at.file, lossy=False)

    if value.ndim == 2:
        return hard(value)
    if top in WHITE and any(
        len(np.unique(m)) > 2 and np.isin(hard(m), (0, top)).all() for m in flat
    ):
        return value > top // 2
    return value


def _are_maps(stack: NDArray[Any]) -> bool:
    """Whether an array has a map of labels for each frame, not a mask for each object."""
    if stack.ndim == 4 and 1 not in stack.shape[:2]:
        return False
    labels = [np.unique(m[m > 0]).tolist() for m in stack.reshape(-1, *stack.shape[-2:])]
    known, lone = {v for one in labels for v in one}, sum(len(one) == 1 for one in labels)
    shared = 1 < len(known) < lone and max(known) < FEW  # or each object has a number of its own
    return shared or any(len(one) > 1 for one in labels)


def _segments(frame: int, at: At, names: Names, notes: list[str]) -> Iterator[Row]:
    """The masks of a frame by the numbers of their objects."""
    for track in at.mapping():
        mask = at.get(track)
        pixels = np.squeeze(np.asarray(mask.value))
        if pixels.ndim != 2 or pixels.dtype.kind not in "buif" or not track.isdecimal():
            mask.refuse("a mask (1, h, w) under the number of its object")
        name = names.get(track, UNKNOWN)
        inside = _cut(mask, pixels, notes) > 0
        yield inside, Instance(name, None, None, 1.0, frame, int(track))


def _of_stack(at: At, stack: NDArray[Any], names: Names, *, people: bool) -> Instances:
    """The masks of a stack: of one image, of frames that an array names, or of all frames."""
    ids, frame = at.maybe(*TRACKS), at.maybe("frame")
    one_id = ids is not None and isinstance(ids.value, np.ndarray) and ids.value.shape == (1,)
    height, width = stack.shape[-2:]
    flat = stack.reshape(-1, height, width)
    rows, tracks, notes = len(flat), None, ()
    bare = people and ids is None and frame is None and (stack.ndim < 4 or 1 in stack.shape[:2])
    sam = stack.ndim == 4 and stack.shape[1] == 1
    in_frames = bare and rows > 1 and (sam or _overlap(flat) > SAME)
    if bare and rows > 1:
        how = "are people of one image; frames need an array 'frame' or 'object_ids' beside"
        if in_frames:
            how = "that lie on each other are a person in as many frames"
        if sam:
            how = "(n, 1, h, w) are a person in n frames; people of one image are (n, h, w)"
        notes = (f"{at.file}: {rows} masks {how}",)
    if in_frames or (stack.ndim == 4 and (stack.shape[1] != 1 or (one_id and frame is None))):
        count = 1 if in_frames else stack.shape[1]
        frames = np.repeat(np.arange(rows // count), count)
        each = np.arange(count) if ids is None else ids.indices(count)
        tracks = np.tile(each, rows // count)
    else:
        frames = np.zeros(rows, dtype=np.int64) if frame is None else frame.indices(rows)
        tracks = None if ids is None else ids.indices(rows)
    words, scores = at.maybe(*CLASSES), at.maybe("scores")
    labels, sure = [UNKNOWN] * rows, np.ones(rows)
    if words is not None and isinstance(words.value, np.ndarray) and words.value.dtype.kind == "U":
        labels = [str(word) for word in words.array((rows,), "text")]
    shapes = (rows,), stack.shape[:2], (rows, 1)
    if scores and isinstance(scores.value, np.ndarray) and scores.value.shape in shapes:
        sure = np.clip(scores.array(scores.value.shape).reshape(-1), 0, 1)

    def row(i: int) -> Instance:
        track = None if tracks is None else int(tracks[i])
        name = names.get(str(i if track is None else track)) or labels[i]
        return Instance(name, None, None, float(sure[i]), int(frames[i]), track)

    things = ((pixels > 0, row(i)) for i, pixels in enumerate(flat))
    return _gathered(things, at.file, "masks", frames.tolist(), notes)


def _frames_first(at: At, stack: NDArray[Any], notes: list[str]) -> NDArray[Any]:
    """A stack (frames, objects, h, w); of which axis frames are, ids say, else overlaps do."""
    a, b = stack.shape[:2]
    ids, turned = at.maybe(*TRACKS), np.swapaxes(stack, 0, 1)
    count = 0 if ids is None or a == b else np.size(ids.value)
    other = count == a if count in (a, b) else _overlap(turned) > _overlap(stack)
    how, few, many = ("objects, frames", a, b) if other else ("frames, objects", b, a)
    notes.append(f"{at.file}: masks ({how}, h, w): {few} people or things in {many} frames")
    return turned if other else stack


def _overlap(stack: NDArray[Any]) -> float:
    """How much of them masks share with the next along the first axis, as those of one person."""
    shares = list[float]()
    for one, other in zip(stack[:-1] > 0, stack[1:] > 0, strict=True):
        sizes = np.minimum(one.sum((-2, -1)), other.sum((-2, -1)))
        both = (one & other).sum((-2, -1))
        shares += (both[sizes > 0] / sizes[sizes > 0]).ravel().tolist()
    return float(np.median(shares)) if shares else 0.0
