"""Masks as pixels: pictures, arrays and dumps of SAM 2, of one image or of frames of a video."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.pickles import load_plain
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import (
    LAST_INDEX,
    At,
    array,
    get,
    integer,
    mapping,
    maybe,
    read_json,
    refuse,
    text,
)
from mover.io.files.images import opened
from mover.io.files.npz import read_npy, read_npz
from mover.io.masks.instances import Instance, Instances, code_of, frames_of
from mover.io.people.values import natural

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
WHITE = (255, 65535, 0xFFFFFF)
NEAR = 8  # values so near to black or white are black or white, where a mask is soft
SAME = 0.5  # overlap of the same person in two frames that follow each other
Names = Mapping[str, str]
"""Categories where the source has none: by number, file name or index."""


def read_label_images(
    paths: Sequence[Path], source: Path, names: Names, *, people: bool = False
) -> Instances:
    """Masks of pictures and of arrays of labels (.npy).

    A category is looked up in labels.json, `names`, then the file name. A picture with an alpha
    channel that is not full, or with one value beside black, is one mask, soft rims or not; one
    with more values is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are the numbers of frames are a video, in which a label is a track.

    Args:
        paths: The files.
        source: The folder or file that the user named.
        names: Categories where the source has none.
        people: Whether they show people: frames then have short numbers, too.
    """
    home = source if source.is_dir() else source.parent
    table = {**_names_beside(home / LABELS), **names}
    paths = sorted((p for p in paths if p.stem.lower() not in NOT_MASKS), key=natural)
    numbers = _numbers_of([path.stem for path in paths], people=people)
    frames, notes = frames_of(list((numbers or {}).values()), f"{source.name}: numbers")
    found, values, sizes = list[Instance](), set[int](), set[tuple[int, int]]()
    for path in paths:
        pixels = _labels_of(path)
        sizes.add((pixels.shape[1], pixels.shape[0]))
        labels = [int(v) for v in np.unique(pixels) if v != 0]
        values.update(labels)
        if len(labels) > MOST_LABELS:
            n = f"{len(labels)} different values"
            raise InputError(f"{path.name}: has {n}, expected at most {MOST_LABELS} labels")
        frame = 0 if numbers is None else frames[numbers[path.stem]]
        words = {**_classes_beside(path), **table}
        for label in labels:
            if numbers is None and len(labels) == 1 and path.suffix.lower() != ".npy":
                name = words.get(path.stem) or _word_of(path.stem) or UNKNOWN
            else:
                name = words.get(str(label), UNKNOWN)
            track = None if numbers is None else label
            found.append(Instance(name, None, code_of(pixels == label), frame=frame, track=track))
    if len(sizes) > 1:
        raise InputError(f"{source.name}: has pictures of {len(sizes)} sizes, expected one")
    if numbers is not None and values <= {max(values, default=0)} and values & set(WHITE):
        found = [Instance(i.category, None, i.mask, frame=i.frame, track=0) for i in found]
        notes = (*notes, f"{source.name}: white masks are one person or thing in all frames")
    if people and numbers is None and len(paths) > 1:
        how = "pictures are people of one image; those of frames are named by numbers: 000000.png"
        notes = (*notes, f"{source.name}: {how}")
    return Instances(
        tuple(found), next(iter(sizes), None), source.name, frozenset(frames.values()), notes
    )


def read_label_folders(folder: Path, names: Names) -> Instances:
    """A folder of folders, one an object, of pictures that are called by their frames (SAM 2's)."""
    folders = sorted((p for p in folder.iterdir() if p.is_dir()), key=natural)
    files = {home: pictures_in(home) for home in folders}
    numbers = _numbers_of([p.stem for paths in files.values() for p in paths], people=True) or {}
    frames, notes = frames_of(list(numbers.values()), f"{folder.name}: numbers")
    found, sizes = list[Instance](), set[tuple[int, int]]()
    for rank, home in enumerate(home for home in folders if files[home]):
        digits = re.findall(r"\d+", home.name)
        track = int(digits[-1]) if digits else rank
        name = names.get(home.name) or _word_of(home.name) or UNKNOWN
        for path in files[home]:
            if path.stem not in numbers:
                raise InputError(f"{path.name}: has no number of a frame in its name")
            pixels = _labels_of(path)
            sizes.add((pixels.shape[1], pixels.shape[0]))
            if (code := code_of(pixels > 0)) is not None:
                found.append(
                    Instance(name, None, code, frame=frames[numbers[path.stem]], track=track)
                )
    if len(sizes) != 1:
        raise InputError(f"{folder.name}: has pictures of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), sizes.pop(), folder.name, frozenset(frames.values()), notes)


def pictures_in(folder: Path) -> list[Path]:
    """Pictures of masks in a folder, of one kind: those without loss before others."""
    for kinds in ((".npy",), (".png",), PICTURES):
        found = [p for p in folder.iterdir() if p.suffix.lower() in kinds]
        if any(p.stem.lower() not in NOT_MASKS for p in found):
            return found
    return []


def _names_beside(path: Path) -> dict[str, str]:
    """The table of labels.json, where there is one."""
    if not path.is_file():
        return {}
    at = read_json(path)
    return {key: text(At(value, at.file, key)) for key, value in mapping(at).items()}


def _classes_beside(path: Path) -> dict[str, str]:
    """Names of the labels of mask_data/mask_00000.npy in json_data/mask_00000.json.

    As the tracking scripts of Grounded-SAM-2 write them.
    """
    file = path.parent.parent / "json_data" / f"{path.stem}.json"
    if path.suffix.lower() != ".npy" or not file.is_file():
        return {}
    given = get(read_json(file), "labels").value
    rows = given.values() if isinstance(given, Mapping) else given
    found = [At(row, file.name, f"labels[{k}]") for k, row in enumerate(rows)]
    return {str(integer(get(row, "instance_id"))): text(get(row, "class_name")) for row in found}


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
    """The numbers of a picture or an array of labels (h, w), 0 where there is nothing."""
    if path.suffix.lower() == ".npy":
        value = np.squeeze(read_npy(path).value)
        if value.ndim != 2 or value.dtype.kind not in "bui":
            refuse(At(value, path.name), "an array of labels (h, w)")
        return value.astype(np.int64)
    return read_labels(path)


def read_labels(path: Path) -> NDArray[np.int64]:
    """The numbers of a picture of labels (h, w): palette, grey values or colours, or its alpha."""
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
        weights = [1, 0, 0] if grey or path.suffix.lower() in LOSSY else [1, 256, 65536]
        pixels = pixels[..., :3] @ weights
    return pixels if drawn else _hardened(pixels, lossy=path.suffix.lower() in LOSSY)


def _hardened(pixels: NDArray[np.int64], *, lossy: bool) -> NDArray[np.int64]:
    """Labels without the grey rims of soft or resized masks: values that fill no area are rims."""
    values = np.unique(pixels)
    most = int(values[-1])
    if len(values) <= 2 or (most < 200 and len(values) < 16):
        return pixels
    if most in WHITE[:2]:
        near = NEAR * most // 255
        clean = np.where(pixels <= near, 0, np.where(pixels >= most - near, most, pixels))
    else:
        clean = pixels
    same = np.ones_like(pixels, dtype=bool)
    for axis in (0, 1):
        equal = np.diff(clean, axis=axis) == 0
        pad = [(int(a == axis), 0) for a in (0, 1)], [(0, int(a == axis)) for a in (0, 1)]
        same &= np.pad(equal, pad[0], constant_values=True)
        same &= np.pad(equal, pad[1], constant_values=True)
    solid, counts = np.unique(clean[same & (clean > 0)], return_counts=True)
    between = np.unique(clean[(clean > 0) & (clean < most)])
    inner = counts[solid < most].sum()
    soft = most in WHITE[:2] and len(between) > 1 and inner <= 0.1 * max(1, counts.sum())
    if lossy or soft:
        return np.where(pixels > most // 2, most, 0)
    if len(between) > 2 * len(solid):
        return np.where(np.isin(clean, solid), clean, 0)
    return pixels


# Arrays of masks, and dumps.


def read_mask_arrays(path: Path, names: Names, *, people: bool = False) -> Instances:
    """Masks of an .npz or .npy file.

    `masks` is (n, h, w), (n, 1, h, w) or (frames, objects, h, w), as booleans, bytes or logits
    (above 0 is inside); or (h, w), a label map. Beside it may stand `scores`, `labels` (names),
    `object_ids` and `frame`. With a single object id (n, 1, h, w) is one thing in n frames, and so
    are n masks of people that lie on each other. Boxes are those of the masks.
    """
    npz = path.suffix.lower() == ".npz"
    at = read_npz(path) if npz else At({"masks": read_npy(path).value}, path.name)
    return of_arrays(at, names, people=people)


def read_mask_dump(path: Path, names: Names, *, people: bool = False) -> Instances:
    """A pickle of what SAM 2's video predictor gives: {frame: {object: mask}}; or of arrays."""
    tree = load_plain(path)
    at = At({"masks": tree} if isinstance(tree, np.ndarray) else tree, path.name)
    at = maybe(at, "video_segments") or at
    rows = [(key, get(at, key)) for key in mapping(at)]
    if not rows or not all(key.isdecimal() and isinstance(row.value, Mapping) for key, row in rows):
        return of_arrays(at, names, people=people)
    found, sizes = list[Instance](), set[tuple[int, int]]()
    for key, row in rows:
        for track in mapping(row):
            mask = get(row, track)
            pixels = np.squeeze(np.asarray(mask.value))
            if pixels.ndim != 2 or pixels.dtype.kind not in "buif" or not track.isdecimal():
                refuse(mask, "a mask (1, h, w) under the number of its object")
            sizes.add((pixels.shape[1], pixels.shape[0]))
            name, code = names.get(track, UNKNOWN), code_of(pixels > 0)
            if code is not None:
                found.append(Instance(name, None, code, frame=int(key), track=int(track)))
    if len(sizes) != 1:
        raise InputError(f"{path.name}: has masks of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), sizes.pop(), path.name, frozenset(int(key) for key, _ in rows))


def of_arrays(at: At, names: Names, *, people: bool) -> Instances:
    """Masks of arrays by their names."""
    given = _first(at, MASKS)
    if given is None:
        refuse(at, f"an array named {', '.join(MASKS)}", f"the arrays {sorted(at.value)[:6]}")
    stack = given.value
    if not isinstance(stack, np.ndarray) or stack.dtype.kind not in "buif" or stack.ndim < 2:
        refuse(given, "an array of masks (n, h, w), (frames, objects, h, w) or labels (h, w)")
    if stack.ndim == 2 and stack.dtype != np.bool_:
        values = [int(v) for v in np.unique(stack[np.isfinite(stack)]).tolist() if v > 0]
        if len(values) > MOST_LABELS:
            refuse(given, f"at most {MOST_LABELS} labels", f"{len(values)} different values")
        found = [Instance(names.get(str(v), UNKNOWN), None, code_of(stack == v)) for v in values]
        return Instances(tuple(found), (stack.shape[1], stack.shape[0]), at.file)
    if stack.ndim > 4 or not stack.size:
        refuse(given, "an array of masks (n, h, w) or (frames, objects, h, w)")
    return _of_stack(at, stack, names, people=people)


def _of_stack(at: At, stack: NDArray[Any], names: Names, *, people: bool) -> Instances:
    """The masks of a stack: of one image, of frames that an array names, or of all frames."""
    ids, frame = _first(at, TRACKS), maybe(at, "frame")
    one_id = ids is not None and isinstance(ids.value, np.ndarray) and ids.value.shape == (1,)
    height, width = stack.shape[-2:]
    flat = stack.reshape(-1, height, width)
    rows, tracks, notes = len(flat), None, ()
    bare = people and ids is None and frame is None and (stack.ndim < 4 or stack.shape[1] == 1)
    in_frames = bare and rows > 1 and _follow_each_other(flat)
    if bare and rows > 1:
        how = "are people of one image; frames need an array 'frame' or 'object_ids' beside"
        how = "that lie on each other are a person in as many frames" if in_frames else how
        notes = (f"{at.file}: {rows} masks {how}",)
    if in_frames or (stack.ndim == 4 and (stack.shape[1] != 1 or (one_id and frame is None))):
        count = 1 if in_frames else stack.shape[1]
        frames = np.repeat(np.arange(rows // count), count)
        each = np.arange(count) if ids is None else _counted(ids, count)
        tracks = np.tile(each, rows // count)
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
    looked = frozenset(frames.tolist())
    return Instances(tuple(found), (width, height), at.file, looked, notes)


def _follow_each_other(flat: NDArray[Any]) -> bool:
    """Whether masks lie on each other as those of one person in the frames of a video do."""
    shares = list[float]()
    for one, other in zip(flat[:-1] > 0, flat[1:] > 0, strict=True):
        least = min(int(one.sum()), int(other.sum()))
        if least:
            shares.append(int((one & other).sum()) / least)
    return len(shares) > 0 and float(np.median(shares)) > SAME


def _first(at: At, keys: Sequence[str]) -> At | None:
    """The first of several names of an array that is there."""
    return next((found for key in keys if (found := maybe(at, key)) is not None), None)


def _counted(at: At, rows: int) -> NDArray[np.int64]:
    """Frames or tracks, one a row."""
    value = array(at, (rows,), "whole").astype(np.int64)
    if (value < 0).any() or (value > LAST_INDEX).any():
        refuse(at, f"whole numbers from 0 to {LAST_INDEX}")
    return value
