"""One picture of the room without people, put together from many, and the furniture in it."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.records import record
from mover.core.types import Detection, Masks, People
from mover.geometry.crops import depth_in
from mover.geometry.rle import decode, encode, mask_boxes
from mover.perceive.networks import Finds
from mover.perceive.steady import Drift, shown_by
from mover.perceive.video import Clip, read_picture

FRAMES = 40  # most that are looked at, evenly over the video
LEAST = 3  # fewest frames that show a pixel; with fewer it is hidden
MARGIN = 0.008  # of the picture's width: how far beyond a mask a person may reach
STRIPS = 16  # parts in which the picture is put together, to save memory
THINGS = frozenset({
    "chair", "couch", "bed", "dining table", "bench", "toilet", "refrigerator", "potted plant",
    "oven", "tv",
})  # fmt: skip
"""COCO's classes that are furniture; cups and books are not."""
SAME = 0.6  # overlap from which on two finds are one thing


@record
class Clean:
    """The reference picture."""

    picture: Float[Tensor, "h w 3"]
    """In [0, 1]."""
    hidden: Bool[Tensor, "h w"]
    """Pixels that no frame, or too few, show empty."""


def reference_of(clip: Clip, drift: Drift, tracks: People) -> Clean:
    """The room without people: the median of the frames that show a pixel empty.

    A person without a mask for some frames is in no median. Where too few frames show a pixel, it
    is that of the frame which shows most of the room. `drift` is what was undone in the clip.
    """
    size = clip.height, clip.width
    chosen = np.linspace(0, len(clip.time) - 1, min(len(clip.time), FRAMES)).round().astype(int)
    pictures, shown = list[NDArray[np.uint8]](), list[NDArray[np.bool_]]()
    for frame in chosen.tolist():
        hidden = np.zeros(size, dtype=bool)
        for row in (tracks.frame == frame).nonzero()[:, 0].tolist():
            hidden |= decode(tracks.masks, row).numpy()
        seen = ~grown(hidden, round(MARGIN * clip.width))
        if drift.verdict != "still":
            seen &= shown_by(drift.H[frame].double().numpy(), size)
        pictures.append(read_picture(clip.path(frame)))
        shown.append(seen)
    best = max(range(len(chosen)), key=lambda k: int(shown[k].sum()))
    if len(chosen) < LEAST:
        picture, hidden = pictures[best], ~shown[best]
    else:
        picture, hidden = median(np.stack(pictures), np.stack(shown))
        picture[hidden] = pictures[best][hidden]
    return Clean(torch.from_numpy(picture).float() / 255, torch.from_numpy(hidden))


def median(
    pictures: NDArray[np.uint8], shown: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Median over the frames (n, h, w, 3) that show a pixel, and which pixels too few show."""
    found = np.empty(pictures.shape[1:], np.uint8)
    for rows in np.array_split(np.arange(len(found)), STRIPS):
        values = torch.from_numpy(pictures[:, rows]).float()
        values[torch.from_numpy(~shown[:, rows])] = torch.nan
        found[rows] = values.nanmedian(0).values.nan_to_num(0).byte().numpy()
    return found, shown.sum(0) < LEAST


def grown(mask: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """A mask with a margin [px]."""
    if steps < 1 or not mask.any():
        return mask
    return depth_in(~mask) <= steps


def detections_in(finds: Finds) -> tuple[Detection, ...]:
    """Furniture as annotations; of finds that cover each other only the surest stays."""
    from pycocotools import mask as coco

    size, kept = [finds.masks.height, finds.masks.width], list[int]()
    codes: Any = [{"size": size, "counts": code} for code in finds.masks.counts]
    boxes, overlap = mask_boxes(finds.masks), coco.iou(codes, codes, [0] * len(codes))
    for row in finds.score.argsort(descending=True).tolist():
        if finds.category[row] in THINGS and not any(overlap[row][k] > SAME for k in kept):
            kept.append(row)
    return tuple(
        Detection(
            id=k, category=finds.category[row], box=boxes[row],
            mask=replace(finds.masks, counts=(finds.masks.counts[row],)),
            score=float(finds.score[row]),
        )
        for k, row in enumerate(kept)
    )  # fmt: skip


def hidden_mask(clean: Clean) -> Masks | None:
    """Where people hide the room in the clean picture; None: nowhere."""
    if not bool(clean.hidden.any()):
        return None
    height, width = clean.hidden.shape
    return Masks(height, width, (encode(clean.hidden),))
