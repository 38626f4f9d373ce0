"""Errors of instance masks: outlines off by some pixels, instances missed."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Bool

from ..geometry.runs import decode
from ..types import Detection, Masks, People
from .render import encode

LEAK = 0.2  # radius of a leak as a share of the root of the mask's area


def grown(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """The mask with its outline moved out by so many pixels, in where negative."""
    from scipy.ndimage import distance_transform_edt

    if pixels == 0 or not mask.any() or mask.all():
        return mask
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    pad = abs(pixels) + 1
    window = np.s_[
        max(0, rows[0] - pad) : rows[-1] + pad + 1, max(0, cols[0] - pad) : cols[-1] + pad + 1
    ]
    part = mask[window]
    out = np.zeros_like(mask)
    if pixels > 0:
        out[window] = np.asarray(distance_transform_edt(~part)) <= pixels
    else:
        out[window] = np.asarray(distance_transform_edt(part)) > -pixels
    return out if out.any() else mask


def noisy_people(
    people: People | None, most: int, missed: float, rng: np.random.Generator
) -> People | None:
    """Masks that grow or shrink by 1 to `most` pixels; some are missing."""
    if people is None:
        return None
    count = len(people.frame)
    off = rng.integers(1, max(1, most) + 1, count) * rng.choice([-1, 1], count) * (most > 0)
    keep = np.flatnonzero(rng.uniform(size=count) >= missed)
    masks = [grown(decode(people.masks, int(k)).numpy(), int(off[k])) for k in keep]
    rows = torch.from_numpy(keep)
    size = (people.masks.height, people.masks.width)
    coded = encode(masks) if masks else Masks(*size, ())
    return People(coded, people.frame[rows], people.person[rows], people.heights)


def noisy_detections(
    detections: tuple[Detection, ...], most: int, rng: np.random.Generator
) -> tuple[Detection, ...]:
    """Masks of objects with outlines that are off; the boxes follow."""
    out: list[Detection] = []
    for one in detections:
        off = int(rng.integers(-most, most + 1))
        if one.mask is None or off == 0:
            out.append(one)
            continue
        mask = grown(decode(one.mask, 0).numpy(), off)
        out.append(dataclasses.replace(one, mask=encode([mask]), box=box_of_mask(mask)))
    return tuple(out)


def leaking(
    detections: tuple[Detection, ...], share: float, rng: np.random.Generator
) -> tuple[Detection, ...]:
    """Some masks of objects run over at one place of their border; the boxes follow."""
    out: list[Detection] = []
    for one in detections:
        leaks, where = rng.uniform(size=2)
        if one.mask is None or leaks >= share:
            out.append(one)
            continue
        mask = leaked(decode(one.mask, 0).numpy(), float(where))
        out.append(dataclasses.replace(one, mask=encode([mask]), box=box_of_mask(mask)))
    return tuple(out)


def leaked(mask: Bool[np.ndarray, "h w"], where: float) -> Bool[np.ndarray, "h w"]:
    """The mask and a disc around a point of its border.

    Args:
        mask: Not empty.
        where: In [0, 1), which point of the border.
    """
    rows, cols = np.nonzero(mask & ~grown(mask, -1))
    if not len(rows):
        return mask
    centre = int(where * len(rows))
    radius = LEAK * np.sqrt(mask.sum())
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    return mask | ((v - rows[centre]) ** 2 + (u - cols[centre]) ** 2 <= radius**2)


def box_of_mask(mask: Bool[np.ndarray, "h w"]) -> torch.Tensor:
    """x_min, y_min, x_max, y_max [px] of a mask that is not empty."""
    rows, cols = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return torch.tensor([cols[0], rows[0], cols[-1] + 1, rows[-1] + 1]).float()
