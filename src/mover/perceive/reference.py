"""The clean picture of a steadied clip, and the furniture in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..geometry.runs import decode
from ..readers.masks import encode, tight_box
from ..records import fingerprint
from ..run import Run
from ..types import Detection, Masks
from .clean import Clean, CleanConfig, clean_picture, spread_frames
from .detect import DetectConfig, DetectInputs, Finds, find_instances, overlap
from .steady import Drift, seen_share
from .track import Tracks, stack_of
from .video import Clip, load_frame, write_jpeg

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


def furniture_of(clean: Clean, folder: Path, config: DetectConfig, run: Run) -> Finds:
    """What the network finds in the clean picture."""
    pixels = (clean.picture * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    folder = folder / fingerprint(clean.picture)  # another picture is another input
    folder.mkdir(parents=True, exist_ok=True)
    write_jpeg(np.ascontiguousarray(pixels), folder / "000000.jpg")
    height, width = clean.hidden.shape
    clip = Clip(str(folder), width, height, torch.zeros(1), None)
    return run.stage(find_instances, DetectInputs(clip, (0,)), config)


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
