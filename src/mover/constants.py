"""Small tensors that never change, made once for each device."""

from functools import cache
from typing import Any

import torch
from torch import Tensor


def constant(values: Any, like: Tensor) -> Tensor:  # noqa: ANN401
    """These values with the type and on the device of `like`: always the same tensor; copy it.

    What an energy needs at every step is made by this: a step that is recorded on a GPU
    (`replay.Replay`) may take nothing from the host.

    Args:
        values: A number or nested tuples of numbers.
        like: Gives type and device.
    """
    return _held(values, like.dtype, like.device)


@cache  # nothing leaves it: a recorded step reads the memory itself
def _held(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:  # noqa: ANN401
    return torch.tensor(values, dtype=dtype, device=device)
