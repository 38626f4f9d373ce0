"""One picture of the room in which no person hides furniture: found, or put together from many."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import fingerprint, record
from mover.core.types import Detection, Masks
from mover.geometry.rle import decode, encode, tight_box
from mover.perceive.config import CleanConfig
from mover.perceive.detect import Finds, overlap
from mover.perceive.steady import Drift, seen_share
from mover.perceive.track import Tracks, stack_of
from mover.perceive.video import Clip, load_frame, write_jpeg

DIFFERENT = 0.1  # of the range of brightness; noise and light change less
PATCH = 5  # [px], edges that are off by a pixel differ in thinner lines

Load = Callable[[int], tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]]
"""Picture of a frame, and where it shows the empty room."""


@record
class Clean:
    """The reference picture."""

    picture: Float[Tensor, "h w 3"]
    """In [0, 1]."""
    hidden: Bool[Tensor, "h w"]
    """Pixels that no frame, or too few, show empty."""
    frame: int
    """The frame that it is; -1: put together."""


def spread_frames(count: int, most: int) -> list[int]:
    """At most so many frames, evenly over all."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, most)).tolist()})


def clean_picture(frames: Sequence[int], load: Load, config: CleanConfig) -> Clean:
    """A frame that shows the room alone, or the median of what all frames show.

    A person standing in a frame without a mask is seen in no median: a frame is taken only if it
    agrees with that.

    Args:
        frames: Which may be used.
        load: Gives a frame and where no person is in it.
        config: How.
    """
    empty, strips = _seen(frames, load, config.strips)
    order = np.argsort(-np.array(empty), kind="stable").tolist()
    picture, shown = load(frames[order[0]])
    if len(frames) < config.least:
        return Clean(picture, ~shown, frames[order[0]])
    median = _median(strips, picture, config.least)
    for k in order[: config.least]:
        picture, shown = load(frames[k])
        if 1 - empty[k] <= config.free and _apart(picture, median) <= config.free:
            return Clean(picture, ~shown, frames[k])
    return median


def _apart(picture: Float[Tensor, "h w 3"], median: Clean) -> float:
    """Share of the picture that lies within patches that are not as in the median."""
    off = ((picture - median.picture).abs().amax(-1) > DIFFERENT) & ~median.hidden
    whole = -torch.nn.functional.max_pool2d(-off[None].float(), PATCH, 1, PATCH // 2)
    return float(whole.mean())


def _seen(
    frames: Sequence[int], load: Load, count: int
) -> tuple[list[float], list[list[Int[Tensor, "_ w 3"]]]]:
    """How much of the room each frame shows, and that in bytes, strip by strip; -1: hidden."""
    empty: list[float] = []
    strips: list[list[Tensor]] = [[] for _ in range(count)]
    for frame in frames:
        picture, shown = load(frame)
        empty.append(float(shown.float().mean()))
        bytes_ = (picture * 255).round().to(torch.int16)
        seen = torch.where(shown[..., None], bytes_, torch.full_like(bytes_, -1))
        for strip, part in zip(strips, seen.tensor_split(count), strict=True):
            strip.append(part)
    return empty, strips


def _median(
    strips: Sequence[Sequence[Int[Tensor, "_ w 3"]]], best: Float[Tensor, "h w 3"], least: int
) -> Clean:
    """The median of the frames that show a pixel; the best frame where too few do."""
    parts = [_of_strip(torch.stack(list(strip))) for strip in strips]
    picture, times = torch.cat([p for p, _ in parts]), torch.cat([n for _, n in parts])
    hidden = times < least
    return Clean(torch.where(hidden[..., None], best, picture), hidden, -1)


def _of_strip(
    values: Tensor,
) -> tuple[Float[Tensor, "h w 3"], Tensor]:
    """Median of what is not -1, and how many there are."""
    times = (values[..., 0] >= 0).sum(0)
    ordered = values.sort(0).values
    skipped = len(values) - times
    index = (skipped + (times - 1).clamp_min(0) // 2).clamp_max(len(values) - 1)
    middle = ordered.gather(0, index[None, ..., None].expand(-1, -1, -1, 3))[0]
    return middle.clamp_min(0).float() / 255, times


# The clean picture of a steadied clip, and the furniture in it.


MARGIN = 0.008  # of the picture's width: how far beyond a mask a person may reach
THINGS = frozenset({
    "chair", "couch", "bed", "dining table", "bench", "toilet", "refrigerator", "potted plant",
    "oven", "tv",
})  # fmt: skip
"""COCO's classes that are furniture; cups and books are not."""
SAME = 0.6  # overlap from which on two finds are one thing


def reference_of(clip: Clip, drift: Drift, tracks: Tracks, config: CleanConfig) -> Clean:
    """The picture of the room without people."""
    size = clip.height, clip.width

    def load(frame: int) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
        rows = (tracks.frame == frame).nonzero()[:, 0].tolist()
        hidden = torch.zeros(size, dtype=torch.bool)
        for row in rows:
            hidden = hidden | decode(tracks.masks, row)
        shown = ~grown(hidden, round(MARGIN * clip.width)) & (seen_share(drift, frame, size) > 0)
        return load_frame(clip.path(frame)), shown

    return clean_picture(spread_frames(len(clip.time), config.frames), load, config)


def grown(mask: Bool[Tensor, "h w"], steps: int) -> Bool[Tensor, "h w"]:
    """A mask with a margin [px]."""
    if steps < 1 or not bool(mask.any()):
        return mask
    from scipy.ndimage import distance_transform_edt

    return torch.from_numpy(distance_transform_edt(~mask.numpy())) <= steps


def clip_of_clean(clean: Clean, folder: Path) -> Clip:
    """The clean picture as a clip of one frame, in which furniture is looked for."""
    pixels = (clean.picture * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    folder = folder / fingerprint(clean.picture)  # another picture is another input
    folder.mkdir(parents=True, exist_ok=True)
    write_jpeg(np.ascontiguousarray(pixels), folder / "000000.jpg")
    height, width = clean.hidden.shape
    return Clip(str(folder), width, height, torch.zeros(1), None)


def detections_in(finds: Finds) -> tuple[Detection, ...]:
    """Furniture as annotations; of finds that cover each other only the surest stays."""
    order = finds.score.argsort(descending=True).tolist()
    masks = stack_of(finds.masks)
    kept: list[int] = []
    for row in order:
        near = overlap(masks[row][None], masks[kept]) if kept else torch.zeros(1, 0)
        if finds.category[row] in THINGS and not bool((near > SAME).any()):
            kept.append(row)
    return tuple(
        Detection(
            id=k, category=finds.category[row], box=tight_box(masks[row]),
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
