"""Where the heavy work is done: on the processor, or on an NVIDIA GPU."""

from collections.abc import Callable
from functools import cache
from typing import Any, Generic, Literal, TypeVar

import torch
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


def finish(device: torch.device) -> None:
    """Wait until a GPU has done what it was given: before a clock is read."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def named(device: torch.device) -> str:
    """What a log calls it: `cpu`, or `cuda` and the name of the GPU."""
    if device.type != "cuda":
        return str(device)
    return f"cuda ({torch.cuda.get_device_name(device)})"


# Small tensors that never change, made once for each device.


def constant(values: Any, like: Tensor) -> Tensor:  # noqa: ANN401
    """These values with the type and on the device of `like`: always the same tensor; copy it.

    What an energy needs at every step is made by this: a step that is recorded on a GPU
    (`devices.Replay`) may take nothing from the host.
    """
    return _held(values, like.dtype, like.device)


@cache  # nothing leaves it: a recorded step reads the memory itself
def _held(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:  # noqa: ANN401
    return torch.tensor(values, dtype=dtype, device=device)


# Steps that are recorded once on a GPU and then replayed, without Python and launches in between.
#
# A step is a function without arguments: what it reads and changes are tensors that stay where they
# are, and it asks the host for nothing. Torch and Warp work in one stream, so that the recording (a
# CUDA graph) holds the work of both.


T = TypeVar("T")
WARM = 3  # steps before the recording: they compile, load, and fill what is held for all steps


class Replay(Generic[T]):
    """A step on a GPU: taken as it is at first, then recorded, from then on replayed.

    What it returns is the same object from the recording on; its tensors are overwritten.
    """

    def __init__(self, step: Callable[[], T], device: torch.device) -> None:
        self._step, self._device = step, device
        self._side = torch.cuda.Stream(device)
        self._graph: torch.cuda.CUDAGraph | None = None
        self._value: T | None = None
        self._taken = 0

    def __call__(self) -> T:
        """Take the next step."""
        with torch.cuda.device(self._device):
            here = torch.cuda.current_stream()
            self._side.wait_stream(here)
            if self._taken < WARM:
                with torch.cuda.stream(self._side):
                    self._value = self._step()
            else:
                self._graph = self._graph or self._recorded()
                with torch.cuda.stream(self._side):
                    self._graph.replay()
            here.wait_stream(self._side)
        self._taken += 1
        assert self._value is not None
        return self._value

    def _recorded(self) -> torch.cuda.CUDAGraph:
        """Record a step; nothing is done yet."""
        self._value = None
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=self._side, capture_error_mode="thread_local"):
            self._value = self._step()
        return graph


def stepper(step: Callable[[], T], device: torch.device, *, still: bool) -> Callable[[], T]:
    """The step itself, or its replay where it is `still` (asks the host for nothing) on a GPU."""
    return Replay(step, device) if still and device.type == "cuda" else step
