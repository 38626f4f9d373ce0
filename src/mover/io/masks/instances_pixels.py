"""Masks as pixels: arrays (SAM 2, SAM 3, transformers) and pictures (labels, alpha channels)."""

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


def read_mask_arrays(path: Path, names: Mapping[str, str]) -> Instances:
    """Masks of an .npz or .npy file.

    `masks` is (n, h, w), (n, 1, h, w) or (frames, objects, h, w), as booleans, bytes or logits
    (above 0 is inside); or (h, w), a label map. Beside it may stand `scores`, `labels` (names),
    `object_ids` and `frame`. With a single object id (n, 1, h, w) is one thing in n frames. Boxes
    are those of the masks.
    """
    at = _load(path)
    given = _first(at, MASKS)
    if given is None:
        refuse(at, f"an array named {', '.join(MASKS)}", f"the arrays {sorted(at.value)[:6]}")
    stack = given.value
    if not isinstance(stack, np.ndarray) or stack.dtype.kind not in "buif" or stack.ndim < 2:
        refuse(given, "an array of masks (n, h, w), (frames, objects, h, w) or labels (h, w)")
    if stack.ndim == 2 and stack.dtype != np.bool_:
        items = _of_labels(stack, names)
        return Instances(tuple(items), (stack.shape[1], stack.shape[0]), path.name)
    return _of_stack(at, given, stack, names)


def _first(at: At, keys: Sequence[str]) -> At | None:
    return next((found for key in keys if (found := maybe(at, key)) is not None), None)


def _load(path: Path) -> At:
    """The arrays of an .npz, or the one of an .npy as `masks`."""
    if path.suffix.lower() == ".npz":
        return read_npz(path)
    return At({"masks": read_npy(path).value}, path.name)


def _of_labels(labels: NDArray[Any], names: Mapping[str, str]) -> list[Instance]:
    """The things of a label map; 0 is nothing, and so is what is below it."""
    values = [int(v) for v in np.unique(labels[np.isfinite(labels)]).tolist() if v > 0]
    return [Instance(names.get(str(v), UNKNOWN), None, code_of(labels == v)) for v in values]


def _of_stack(at: At, given: At, stack: NDArray[Any], names: Mapping[str, str]) -> Instances:
    many = stack.ndim == 4 and (stack.shape[1] != 1 or _is_one_track(at))
    if stack.ndim not in (2, 3, 4) or not stack.size:
        refuse(given, "an array of masks (n, h, w) or (frames, objects, h, w)")
    height, width = stack.shape[-2:]
    flat = stack.reshape(-1, height, width)
    rows = len(flat)
    frames = np.repeat(np.arange(len(stack)), stack.shape[1]) if many else _frames(at, rows)
    tracks, words = _tracks(at, stack, many, rows), _words(at, rows)
    scores = _scores(at, rows)
    found: list[Instance] = []
    for i, pixels in enumerate(flat):
        code = code_of(pixels > 0)
        track = None if tracks is None else int(tracks[i])
        key = str(i if track is None else track)
        name = names.get(key) or (words[i] if words else UNKNOWN)
        if code is not None:
            found.append(Instance(name, None, code, scores[i], int(frames[i]), track))
    return Instances(tuple(found), (width, height), at.file)


def _is_one_track(at: At) -> bool:
    """Whether a single id names all masks, and nothing else says which frames they are of."""
    known = _first(at, TRACKS)
    ids = None if known is None or maybe(at, "frame") is not None else known.value
    return isinstance(ids, np.ndarray) and ids.shape == (1,)


def _frames(at: At, rows: int) -> NDArray[np.int64]:
    """Frame of each mask: given, or all of one image."""
    known = maybe(at, "frame")
    return np.zeros(rows, dtype=np.int64) if known is None else _counted(known, rows)


def _counted(at: At, rows: int) -> NDArray[np.int64]:
    value = array(at, (rows,), "whole").astype(np.int64)
    if (value < 0).any() or (value > LAST_INDEX).any():
        refuse(at, f"whole numbers from 0 to {LAST_INDEX}")
    return value


def _tracks(at: At, stack: NDArray[Any], many: bool, rows: int) -> NDArray[np.int64] | None:
    """Track of each mask; None: they are not tracked."""
    known = _first(at, TRACKS)
    count = stack.shape[1] if many else rows
    if known is None:
        return np.tile(np.arange(count), len(stack)) if many else None
    ids = _counted(known, count)
    return np.tile(ids, len(stack)) if many else ids


def _words(at: At, rows: int) -> list[str] | None:
    known = _first(at, CLASSES)
    if known is None or not isinstance(known.value, np.ndarray) or known.value.dtype.kind != "U":
        return None
    return [str(word) for word in array(known, (rows,), "text")]


def _scores(at: At, rows: int) -> list[float]:
    """How sure each mask is, from 0 to 1."""
    known = maybe(at, "scores")
    if known is None or not isinstance(known.value, np.ndarray) or known.value.size != rows:
        return [1.0] * rows
    value = array(get(at, "scores"), known.value.shape).reshape(-1)
    return [float(v) for v in np.clip(value, 0, 1)]


LABELS = "labels.json"
NOT_MASKS = frozenset({"image", "rgb", "input", "reference", "depth"})
"""Names of pictures that lie beside masks."""
MOST_LABELS = 256


def read_mask_pictures(
    paths: Sequence[Path], source: Path, names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """Masks of pictures; a category is looked up in labels.json, `names`, then the file name.

    A picture with an alpha channel that is not full is one mask. One with two values is one mask;
    one with more is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are numbers of six digits or more, all label maps, are frames of a video.

    Raises:
        InputError: If a picture cannot be read or sizes differ.
    """
    table = {**_labels(source), **names}
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


def _labels(source: Path) -> dict[str, str]:
    """Categories of labels.json beside the pictures, by number or file name."""
    path = (source if source.is_dir() else source.parent) / LABELS
    if not path.is_file():
        return {}
    at = read_json(path)
    return {key: text(At(value, at.file, key)) for key, value in mapping(at).items()}


def read_labels(path: Path) -> NDArray[np.int64]:
    """The numbers of a picture of labels (h, w): palette or grey values, or alpha above 0."""
    with opened(path, expected="a picture of masks", bombs="error") as picture:
        return _numbers(picture)


def _numbers(picture: Any) -> NDArray[np.int64]:  # noqa: ANN401
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
        name = table.get(path.stem) or _named(path.stem)
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


def _named(stem: str) -> str:
    """`chair` of chair_0, 03_chair or chair."""
    words = re.sub(r"[0-9]+", " ", stem).replace("_", " ").replace("-", " ").split()
    plain = " ".join(word for word in words if word.lower() not in ("mask", "masks"))
    return plain or UNKNOWN
