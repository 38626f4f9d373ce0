"""Masks as pixels: arrays (.npz, .npy) and pictures (labels, alpha channels)."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import (
    LAST_INDEX,
    At,
    array,
    get,
    mapping,
    maybe,
    read_json,
    refuse,
    text,
)
from mover.io.files.images import opened
from mover.io.files.npz import read_npy, read_npz
from mover.io.masks.instances import Instance, Instances, code_of

MASKS = ("masks", "pred_masks", "mask", "segmentation", "arr_0")
TRACKS = ("object_ids", "obj_ids", "track_ids", "track", "person", "ids")
CLASSES = ("labels", "classes", "category", "class_names")
LABELS = "labels.json"
NOT_MASKS = frozenset({"image", "rgb", "input", "reference", "depth"})
"""Names of pictures that lie beside masks."""
MOST_LABELS = 256


def read_mask_arrays(path: Path, names: Mapping[str, str]) -> Instances:
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
    if stack.ndim > 2 or stack.dtype == np.bool_:
        return _of_stack(at, given, stack, names)
    values = [int(v) for v in np.unique(stack[np.isfinite(stack)]).tolist() if v > 0]
    items = [Instance(names.get(str(v), UNKNOWN), None, code_of(stack == v)) for v in values]
    return Instances(tuple(items), (stack.shape[1], stack.shape[0]), path.name)


def _first(at: At, keys: Sequence[str]) -> At | None:
    """The first of several names of an array that is there."""
    return next((found for key in keys if (found := maybe(at, key)) is not None), None)


def _of_stack(at: At, given: At, stack: NDArray[Any], names: Mapping[str, str]) -> Instances:
    """The masks of a stack: of one image, of frames that an array names, or of all frames."""
    ids, frame = _first(at, TRACKS), maybe(at, "frame")
    one_id = ids is not None and isinstance(ids.value, np.ndarray) and ids.value.shape == (1,)
    many = stack.ndim == 4 and (stack.shape[1] != 1 or (one_id and frame is None))
    if stack.ndim not in (2, 3, 4) or not stack.size:
        refuse(given, "an array of masks (n, h, w) or (frames, objects, h, w)")
    height, width = stack.shape[-2:]
    flat = stack.reshape(-1, height, width)
    rows = len(flat)
    if many:
        frames = np.repeat(np.arange(len(stack)), stack.shape[1])
        each = np.arange(stack.shape[1]) if ids is None else _counted(ids, stack.shape[1])
        tracks = np.tile(each, len(stack))
    else:
        frames = np.zeros(rows, dtype=np.int64) if frame is None else _counted(frame, rows)
        tracks = None if ids is None else _counted(ids, rows)
    words, scores = _words(at, rows), _scores(at, rows)
    found: list[Instance] = []
    for i, pixels in enumerate(flat):
        code = code_of(pixels > 0)
        track = None if tracks is None else int(tracks[i])
        key = str(i if track is None else track)
        name = names.get(key) or (words[i] if words else UNKNOWN)
        if code is not None:
            found.append(Instance(name, None, code, scores[i], int(frames[i]), track))
    return Instances(tuple(found), (width, height), at.file)


def _counted(at: At, rows: int) -> NDArray[np.int64]:
    """Frames or tracks, one a row."""
    value = array(at, (rows,), "whole").astype(np.int64)
    if (value < 0).any() or (value > LAST_INDEX).any():
        refuse(at, f"whole numbers from 0 to {LAST_INDEX}")
    return value


def _words(at: At, rows: int) -> list[str] | None:
    known = _first(at, CLASSES)
    if known is None or not isinstance(known.value, np.ndarray) or known.value.dtype.kind != "U":
        return None
    return [str(word) for word in array(known, (rows,), "text")]


def _scores(at: At, rows: int) -> list[float]:
    """Confidence of each mask, from 0 to 1."""
    known = maybe(at, "scores")
    if known is None or not isinstance(known.value, np.ndarray) or known.value.size != rows:
        return [1.0] * rows
    value = array(get(at, "scores"), known.value.shape).reshape(-1)
    return [float(v) for v in np.clip(value, 0, 1)]


def read_mask_pictures(
    paths: Sequence[Path], source: Path, names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """Masks of pictures; a category is looked up in labels.json, `names`, then the file name.

    A picture with an alpha channel that is not full is one mask. One with two values is one mask;
    one with more is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are numbers of six digits or more, all label maps, are frames of a video.
    """
    labels = (source if source.is_dir() else source.parent) / LABELS
    table = dict(names)
    if labels.is_file():
        at = read_json(labels)
        words = {key: text(At(value, at.file, key)) for key, value in mapping(at).items()}
        table = words | table
    paths = [p for p in paths if p.stem.lower() not in NOT_MASKS]
    video = len(paths) > 1 and all(re.fullmatch(r"[0-9]{5,8}", p.stem) for p in paths)
    found: list[Instance] = []
    sizes: set[tuple[int, int]] = set()
    for path in paths:
        pixels = read_labels(path)
        sizes.add((pixels.shape[1], pixels.shape[0]))
        found += _of_picture(pixels, path, table, int(path.stem) if video else None)
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


def _of_picture(
    pixels: NDArray[np.int64], path: Path, table: Mapping[str, str], frame: int | None
) -> list[Instance]:
    values = [v for v in np.unique(pixels).tolist() if v != 0]
    if len(values) > MOST_LABELS:
        found = f"{len(values)} different values"
        raise InputError(f"{path.name}: has {found}, expected at most {MOST_LABELS} labels")
    if len(values) == 1 and frame is None:
        words = re.sub(r"[\d_-]+", " ", path.stem).split()  # `chair` of chair_0, 03_chair or chair
        plain = " ".join(word for word in words if word.lower() not in ("mask", "masks"))
        name = table.get(path.stem) or plain or UNKNOWN
        return [Instance(name, None, code_of(pixels == values[0]))]
    return [
        Instance(
            category=table.get(str(value), UNKNOWN),
            box=None,
            mask=code_of(pixels == value),
            frame=frame or 0,
            track=value if frame is not None else None,
        )
        for value in values
    ]
