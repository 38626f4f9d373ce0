"""PHALP's results (the tracker of 4D-Humans): SMPL in a square camera with a huge focal length.

The networks see 256 px and assume 5000 px there; the full image is padded to a square, so that
the focal length is 5000 / 256 times its longer side and the principal point its middle.
"""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.io.files.fields import At, items, mapping
from mover.io.people.found import Found, Known, joined, people_rows
from mover.io.people.lens import assumed_lens, lens
from mover.io.people.values import (
    Numbers,
    angles,
    either,
    natural,
    need,
    numbers,
    one_number,
    only_file,
    read_any,
    rows,
    stacked,
    whole,
)

FOCAL, CROP = 5000.0, 256.0  # [px]


def read_phalp(path: Path, known: Known) -> Found:
    """Bodies of 4D-Humans (PHALP): the one .pkl of a folder, or the file itself.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    at = read_any(only_file(path, "**/*.pkl", "the results of PHALP"))
    frames = mapping(at)
    found: list[Found] = []
    for index, name in enumerate(sorted(frames, key=lambda key: natural(Path(str(key))))):
        found += _frame(At(frames[name], at.file, str(name)), index, known)
    if not found:
        raise InputError(f"{at.file}: has no people in {len(frames)} frames")
    return joined(found)


def _frame(at: At, index: int, known: Known) -> list[Found]:
    """The people of one frame; those that were not seen but foretold are left out."""
    bodies, cameras = items(need(at, "smpl")), items(_list(need(at, "camera")))
    tids = whole(need(at, "tid", "tracked_ids"))
    if not len(bodies) == len(cameras) == len(tids):
        n = f"{len(tids)} tracks, {len(bodies)} bodies and {len(cameras)} cameras"
        raise InputError(f"{at.place} has {n}, expected as many of each")
    seen = _seen(at, tids)
    time = either(at, "time")
    frame = index if time is None else int(one_number(time))
    number = torch.tensor([frame if frame >= 0 else index])
    sizes = either(at, "size")
    return [
        people_rows(known, "smpl", number, int(tid), _told(body, camera), K=_lens(sizes, k, known))
        for k, (tid, body, camera) in enumerate(zip(tids, bodies, cameras, strict=True))
        if seen[k]
    ]


def _seen(at: At, tids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which people were seen in this frame, not only foretold."""
    ages, ids = either(at, "tracked_time"), either(at, "tracked_ids")
    if ages is not None and numbers(ages).size == len(tids):
        return numbers(ages).reshape(-1) == 0
    if ids is not None:
        return np.isin(tids, whole(ids))
    return np.ones(len(tids), dtype=np.bool_)


def _list(at: At) -> At:
    value = list(at.value) if isinstance(at.value, np.ndarray) else at.value
    return At(value, at.file, at.field)


def _told(body: At, camera: At) -> tuple[Numbers, Numbers, Numbers]:
    """Angles, shape and place of one person."""
    root = angles(need(body, "global_orient"), 1, 1)
    whole = np.concatenate([root, angles(need(body, "body_pose"), 1, 23)], 1)
    return whole, rows(need(body, "betas"), 1, 10), rows(camera, 1, 3)


def _lens(sizes: At | None, row: int, known: Known) -> Tensor | None:
    """The lens that was assumed for an image of this size (height, width)."""
    if sizes is None:
        return assumed_lens(known, lambda *size: FOCAL / CROP * max(size), 1)
    pairs = stacked(sizes, 2)
    height, width = (float(v) for v in pairs[min(row, len(pairs) - 1)])
    focal = known.focal or FOCAL / CROP * max(width, height)
    return lens(focal, width, height).float()[None]
