"""One picture of the room in which nobody hides furniture: found, or put together from many."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..records import record

Load = Callable[[int], tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]]
"""Picture of a frame, and where it shows the empty room."""


@dataclass(frozen=True)
class CleanConfig:
    """How the reference picture is made."""

    frames: int = 40
    """Most frames that are looked at, evenly over the video."""
    free: float = 0.0005
    """Share of the picture that may be hidden in a frame that is taken as it is."""
    least: int = 3
    """Fewest frames that must show a pixel; with fewer it is hidden."""
    strips: int = 16
    """Parts in which the picture is put together, to save memory."""


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
    """The frame that shows most of the room, or the median of what all frames show.

    Args:
        frames: Which may be used.
        load: Gives a frame and where nobody is in it.
        config: How.
    """
    empty = [float(load(frame)[1].float().mean()) for frame in frames]
    best = int(np.argmax(empty))
    picture, shown = load(frames[best])
    if 1 - empty[best] <= config.free or len(frames) < config.least:
        return Clean(picture, ~shown, frames[best])
    return _median(frames, load, picture, config)


def _median(
    frames: Sequence[int], load: Load, best: Float[Tensor, "h w 3"], config: CleanConfig
) -> Clean:
    """The median of the frames that show a pixel; the best frame where too few do."""
    rows = torch.arange(best.shape[0]).chunk(config.strips)
    stacks: list[list[Tensor]] = [[] for _ in rows]
    for frame in frames:
        picture, shown = load(frame)
        bytes_ = (picture * 255).round().to(torch.int16)
        seen = torch.where(shown[..., None], bytes_, torch.full_like(bytes_, -1))
        for strip, part in zip(stacks, rows, strict=True):
            strip.append(seen[part])
    parts = [_of_strip(torch.stack(strip)) for strip in stacks]
    picture, times = torch.cat([p for p, _ in parts]), torch.cat([n for _, n in parts])
    hidden = times < config.least
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
