"""COCO's compressed run-length code of masks; the codes that are read are checked first."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Masks


def decode(masks: Masks, index: int) -> Bool[Tensor, "h w"]:
    """One of the masks as an image."""
    runs, height, width = run_lengths(masks.counts[index]), masks.height, masks.width
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height)
    first = int(runs[0]) // height  # only what is not background is turned
    end = width - int(runs[-1]) // height if len(runs) % 2 else width
    image = np.zeros((height, width), dtype=bool)
    image[:, first:end] = flat[first:end].T
    return torch.from_numpy(image)


def run_lengths(counts: bytes) -> NDArray[np.int64]:
    """The runs (background first, down the columns) of a compressed code.

    Each run is written in groups of five bits, least first, as the difference from the run two
    before; the sixth bit of a character says that another follows.

    Raises:
        ValueError: If the code is malformed.
    """
    codes = np.frombuffer(counts, np.uint8).astype(np.int64) - 48
    if ((codes < 0) | (codes > 63)).any():
        raise ValueError("characters outside of '0' to 'o'")
    ends = np.flatnonzero(codes < 32)
    if not len(ends) or ends[-1] != len(codes) - 1:
        raise ValueError("a code that is cut off")
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 7:
        raise ValueError("a run of more than 35 bits")
    shift = 5 * (np.arange(len(codes)) - np.repeat(starts, lengths))
    values = np.add.reduceat((codes & 31) << shift, starts)
    values -= np.where(codes[ends] & 16, np.int64(1) << (5 * lengths), 0)
    values[1::2], values[2::2] = np.cumsum(values[1::2]), np.cumsum(values[2::2])
    return values


def resampled(
    masks: Masks, index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> bytes | None:
    """The code of one of the masks at these rows and columns, both ascending; None: empty there.

    Each run of a column stays one in each column that shows it; runs that then touch are joined.
    """
    from pycocotools import mask as coco

    high, ends = masks.height, np.cumsum(run_lengths(masks.counts[index]))
    starts, stops = ends[:-1:2], ends[1::2]
    spans = np.where(stops > starts, (stops - 1) // high - starts // high + 1, 0)
    run = np.repeat(np.arange(len(spans)), spans)
    column = starts[run] // high + np.arange(len(run)) - (np.cumsum(spans) - spans)[run]
    top = np.searchsorted(rows, (starts[run] - column * high).clip(0))
    bottom = np.searchsorted(rows, (stops[run] - column * high).clip(max=high))
    first = np.searchsorted(columns, column)
    copies = np.where(bottom > top, np.searchsorted(columns, column, "right") - first, 0)
    piece = np.repeat(np.arange(len(copies)), copies)
    shown = first[piece] + np.arange(len(piece)) - (np.cumsum(copies) - copies)[piece]
    starts, stops = (np.sort(shown * len(rows) + end[piece]) for end in (top, bottom))
    if not len(starts):
        return None
    new = np.append(True, starts[1:] > stops[:-1])
    borders = np.stack([starts[new], stops[np.append(new[1:], True)]], 1).reshape(-1)
    runs = np.diff(np.concatenate([[0], borders, [len(rows) * len(columns)]])).tolist()
    tree: Any = {"size": [len(rows), len(columns)], "counts": runs[:-1] if not runs[-1] else runs}
    return coco.frPyObjects(tree, len(rows), len(columns))["counts"]  # pyright: ignore


def encode(mask: Bool[Tensor, "h w"]) -> bytes:
    """The compressed run-length code of a mask."""
    from pycocotools import mask as coco

    code: Any = coco.encode(np.asfortranarray(mask.cpu().numpy(), dtype=np.uint8))
    return code["counts"]


def thinned(masks: Masks, index: int, step: int) -> NDArray[np.bool_]:
    """Every `step`-th pixel of one of the masks, from the middle of the first step."""
    return decode(masks, index).numpy()[step // 2 :: step, step // 2 :: step]


def area(masks: Masks, index: int) -> int:
    """How many pixels of one of the masks are set."""
    from pycocotools import mask as coco

    code: Any = {"size": [masks.height, masks.width], "counts": masks.counts[index]}
    return int(coco.area(code))


def mask_boxes(masks: Masks) -> Float[Tensor, "masks 4"]:
    """x_min, y_min, x_max, y_max of each of the masks [px]; zeros where one is empty."""
    from pycocotools import mask as coco

    size = [masks.height, masks.width]
    codes: Any = [{"size": size, "counts": code} for code in masks.counts]
    found = torch.from_numpy(np.asarray(coco.toBbox(codes), np.float32).reshape(-1, 4))
    return torch.cat([found[:, :2], found[:, :2] + found[:, 2:]], 1)


def joined(masks: Sequence[Masks]) -> Masks:
    """Masks of one image size, one after the other."""
    counts = tuple(code for m in masks for code in m.counts)
    return Masks(masks[0].height, masks[0].width, counts)


def tight_box(mask: Bool[Tensor, "h w"]) -> Float[Tensor, "4"]:
    """x_min, y_min, x_max, y_max of the pixels that are set [px]."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    box = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    return torch.stack(box).to(torch.get_default_dtype())
