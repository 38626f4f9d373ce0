"""Masks: run-length codes, polygons and images of booleans (COCO)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.runs import decode as decode
from ..geometry.runs import run_lengths as run_lengths
from ..records import InputError
from ..types import Masks

CORNERS = 3  # a polygon has at least so many


def encode(mask: Bool[Tensor, "h w"]) -> bytes:
    """The compressed run-length code of a mask."""
    from pycocotools import mask as coco

    code: Any = coco.encode(np.asfortranarray(mask.cpu().numpy(), dtype=np.uint8))
    return code["counts"]


def thinned(masks: Masks, index: int, step: int) -> NDArray[np.bool_]:
    """Every `step`-th pixel of one of the masks, without unpacking the rest."""
    rows = np.arange(step // 2, masks.height, step)
    columns = np.arange(step // 2, masks.width, step)
    ends = np.cumsum(run_lengths(masks.counts[index]))
    places = columns[None, :] * masks.height + rows[:, None]
    return np.searchsorted(ends, places, side="right") % 2 == 1


def area(masks: Masks, index: int) -> int:
    """How many pixels of one of the masks are set."""
    return int(run_lengths(masks.counts[index])[1::2].sum())


def joined(masks: Sequence[Masks]) -> Masks:
    """Masks of one image size, one after the other."""
    counts = tuple(code for m in masks for code in m.counts)
    return Masks(masks[0].height, masks[0].width, counts)


def tight_box(mask: Bool[Tensor, "h w"]) -> Float[Tensor, "4"]:
    """x_min, y_min, x_max, y_max of the pixels that are set [px]."""
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    box = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
    return torch.stack(box).to(torch.get_default_dtype())


def from_coco(segmentation: Any, height: int, width: int, where: str) -> bytes:  # noqa: ANN401
    """The compressed run-length code of COCO's polygons or of either of its run-length codes.

    Args:
        segmentation: The value of an annotation's field.
        height: Of the image [px].
        width: Of the image [px].
        where: File and field, for messages.

    Raises:
        InputError: If it is malformed or does not fit the image. It may be empty.
    """
    if isinstance(segmentation, list | tuple):
        return _from_polygons(segmentation, height, width, where)
    if not isinstance(segmentation, dict):
        kinds = "polygons [[x, y, ...], ...] or a run-length code {size, counts}"
        raise InputError(f"{where} has {type(segmentation).__name__}, expected {kinds}")
    size, counts = segmentation.get("size"), segmentation.get("counts")
    if not isinstance(size, list | tuple) or tuple(size) != (height, width):
        at_most = str(size)[:40]
        raise InputError(f"{where} has size {at_most}, expected [{height}, {width}] (h, w)")
    runs = _runs(counts, where)
    if (runs < 0).any() or runs.sum() != height * width:
        found = f"runs that sum to {runs.sum()}" if (runs >= 0).all() else "a negative run"
        raise InputError(
            f"{where} has counts with {found}, expected runs that sum to {height} x {width}"
        )
    return counts if isinstance(counts, bytes) else _compressed(runs, height, width)


def _runs(counts: Any, where: str) -> NDArray[np.int64]:  # noqa: ANN401
    """The runs of a code of either kind."""
    if isinstance(counts, list | tuple):
        if not all(type(n) is int and abs(n) < 1 << 40 for n in counts):
            raise InputError(f"{where} has a list of counts, expected whole numbers in it")
        return np.array(counts, dtype=np.int64)
    if not isinstance(counts, str | bytes):
        kinds = "a list of runs or a compressed code"
        raise InputError(f"{where} has {type(counts).__name__} as counts, expected {kinds}")
    try:
        return run_lengths(counts if isinstance(counts, bytes) else counts.encode("ascii"))
    except ValueError as error:
        raise InputError(
            f"{where} has counts with {error}, expected COCO's compressed code"
        ) from error


def _compressed(runs: NDArray[np.int64], height: int, width: int) -> bytes:
    """The compressed code of runs."""
    from pycocotools import mask as coco

    code: Any = {"size": [height, width], "counts": [int(n) for n in runs]}
    return coco.frPyObjects(code, height, width)["counts"]  # pyright: ignore


def _from_polygons(polygons: Sequence[Any], height: int, width: int, where: str) -> bytes:
    """The union of polygons, clipped to the image."""
    from pycocotools import mask as coco

    if not polygons:
        raise InputError(f"{where} has no polygon, expected [[x, y, ...], ...]")
    for i, polygon in enumerate(polygons):
        _check_polygon(polygon, height, width, f"{where} has polygon {i} with")
    outlines: Any = [[float(v) for v in polygon] for polygon in polygons]
    codes: Any = coco.frPyObjects(outlines, height, width)
    return coco.merge(codes)["counts"]  # pyright: ignore


def _check_polygon(polygon: Any, height: int, width: int, where: str) -> None:  # noqa: ANN401
    """Refuse what the rasteriser would crash on or draw as nonsense."""
    real = isinstance(polygon, list | tuple) and all(type(v) in (int, float) for v in polygon)
    if not real or len(polygon) < 2 * CORNERS or len(polygon) % 2:
        found = f"{len(polygon)} items" if isinstance(polygon, list | tuple) else str(polygon)[:40]
        raise InputError(f"{where} {found}, expected numbers x, y of {CORNERS} corners or more")
    reach = 2 * max(height, width)
    if not all(-reach <= v <= reach for v in polygon):
        raise InputError(f"{where} a corner far outside, expected pixels of the image")


def leaves_image(segmentation: Any, height: int, width: int) -> bool:  # noqa: ANN401
    """Whether polygons reach more than a pixel beyond the image and are clipped."""
    if not isinstance(segmentation, list):
        return False
    xs = [v for polygon in segmentation for v in polygon[0::2]]
    ys = [v for polygon in segmentation for v in polygon[1::2]]
    return min(xs) < -1 or max(xs) > width + 1 or min(ys) < -1 or max(ys) > height + 1
