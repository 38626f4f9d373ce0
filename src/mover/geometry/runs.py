"""COCO's compressed run-length code of masks, written and read without its C extension."""

import numpy as np
import torch
from jaxtyping import Bool
from numpy.typing import NDArray
from torch import Tensor

from ..types import Masks


def decode(masks: Masks, index: int) -> Bool[Tensor, "h w"]:
    """One of the masks as an image."""
    runs = run_lengths(masks.counts[index])
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    image = flat.reshape(masks.width, masks.height).T
    return torch.from_numpy(np.ascontiguousarray(image))


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
