"""Where the heavy work is done: on the processor, or on an NVIDIA GPU."""

from functools import cache
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError

Choice = Literal["auto", "cpu", "cuda"]
CPU = torch.device("cpu")


def device_of(choice: Choice) -> torch.device:
    """The device that is meant; `auto`: the GPU where torch sees one.

    Raises:
        InputError: If there is no GPU, or torch was built without CUDA.
    """
    there = torch.cuda.is_available()
    if choice == "cuda" and not there:
        built = torch.backends.cuda.is_built()
        reason = "torch finds no NVIDIA GPU" if built else f"torch {torch.__version__} has no CUDA"
        raise InputError(f"--device cuda: {reason}, expected a GPU; --device cpu needs none")
    return (
        CPU if choice == "cpu" or not there else torch.device("cuda", torch.cuda.current_device())
    )


def named(device: torch.device) -> str:
    """What a log calls it: `cpu`, or `cuda` and the name of the GPU."""
    return str(device) if device.type != "cuda" else f"cuda ({torch.cuda.get_device_name(device)})"


def constant(values: Any, like: Tensor) -> Tensor:  # noqa: ANN401
    """These values with the type and on the device of `like`: always the same tensor; copy it."""
    return _made(values, dtype=like.dtype, device=like.device)


_made = cache(torch.tensor)


def lstsq(left: Float[Tensor, "rows unknowns"], right: Tensor) -> Tensor:
    """The x of least |left @ x - right|, to the same bits each time, for one column or more.

    The default driver of `torch.linalg.lstsq` on the processor (gelsy) reads pivots that are
    not set: its last bits, and the search that starts from them, differ from run to run.
    """
    driver = "gelsd" if left.device.type == "cpu" else "gels"  # all that CUDA has
    columns = right.reshape(len(right), -1)
    return torch.linalg.lstsq(left, columns, driver=driver).solution.reshape(-1, *right.shape[1:])
