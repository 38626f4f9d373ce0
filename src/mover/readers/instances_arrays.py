"""Masks as arrays: SAM 2, SAM 3 and transformers saved with numpy."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import BROKEN, InputError
from .fields import LAST_INDEX, At, array, get, maybe, reason, refuse
from .instances import Instance, Instances, code_of
from .npz_file import check_array_header, read_npz
from .parts import UNKNOWN

MASKS = ("masks", "pred_masks", "mask", "segmentation", "arr_0")
TRACKS = ("object_ids", "obj_ids", "track_ids", "track", "person", "ids")
CLASSES = ("labels", "classes", "category", "class_names")


def read_mask_arrays(
    path: Path, names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """Masks of an .npz or .npy file.

    `masks` is (n, h, w), (n, 1, h, w) or (frames, objects, h, w), as booleans, bytes or logits
    (above 0 is inside); or (h, w), a label map. Beside it may stand `scores`, `labels` (names),
    `object_ids` and `frame`. With a single object id (n, 1, h, w) is one thing in n frames. Boxes
    are those of the masks.

    Raises:
        InputError: If the arrays are wrong.
    """
    at = _load(path)
    given = next((found for key in MASKS if (found := maybe(at, key)) is not None), None)
    if given is None:
        refuse(at, f"an array named {', '.join(MASKS)}", f"the arrays {sorted(at.value)[:6]}")
    stack = given.value
    if not isinstance(stack, np.ndarray) or stack.dtype.kind not in "buif" or stack.ndim < 2:
        refuse(given, "an array of masks (n, h, w), (frames, objects, h, w) or labels (h, w)")
    if stack.ndim == 2 and stack.dtype != np.bool_:
        items = _of_labels(stack, names)
        return Instances(tuple(items), (stack.shape[1], stack.shape[0]), path.name)
    return _of_stack(at, given, stack, names, size)


def _load(path: Path) -> At:
    """The arrays of an .npz, or the one of an .npy as `masks`."""
    if path.suffix.lower() == ".npz":
        return read_npz(path)
    return At({"masks": read_array(path).value}, path.name)


def read_array(path: Path) -> At:
    """The array of an .npy file.

    Raises:
        InputError: If it is missing, broken, or holds pickled objects.
    """
    try:
        check_array_header(path)
        return At(np.load(path, allow_pickle=False), path.name)
    except BROKEN as error:
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected an .npy file"
        ) from error


def _of_labels(labels: NDArray[Any], names: Mapping[str, str]) -> list[Instance]:
    """The things of a label map; 0 is nothing, and so is what is below it."""
    values = [int(v) for v in np.unique(labels[np.isfinite(labels)]).tolist() if v > 0]
    return [Instance(names.get(str(v), UNKNOWN), None, code_of(labels == v)) for v in values]


def _of_stack(
    at: At, given: At, stack: NDArray[Any], names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """The things of a stack of masks."""
    del size
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
    known = next((found for key in TRACKS if (found := maybe(at, key)) is not None), None)
    ids = None if known is None or maybe(at, "frame") is not None else known.value
    return isinstance(ids, np.ndarray) and ids.shape == (1,)


def _frames(at: At, rows: int) -> NDArray[np.int64]:
    """Frame of each mask: given, or all of one image."""
    known = maybe(at, "frame")
    if known is None:
        return np.zeros(rows, dtype=np.int64)
    return _counted(known, rows)


def _counted(at: At, rows: int) -> NDArray[np.int64]:
    value = array(at, (rows,), "whole").astype(np.int64)
    if (value < 0).any() or (value > LAST_INDEX).any():
        refuse(at, f"whole numbers from 0 to {LAST_INDEX}")
    return value


def _tracks(at: At, stack: NDArray[Any], many: bool, rows: int) -> NDArray[np.int64] | None:
    """Track of each mask; None: they are not tracked."""
    known = next((found for key in TRACKS if (found := maybe(at, key)) is not None), None)
    count = stack.shape[1] if many else rows
    if known is None:
        return np.tile(np.arange(count), len(stack)) if many else None
    ids = _counted(known, count)
    return np.tile(ids, len(stack)) if many else ids


def _words(at: At, rows: int) -> list[str] | None:
    """Names of the masks."""
    known = next((found for key in CLASSES if (found := maybe(at, key)) is not None), None)
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
