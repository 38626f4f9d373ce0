"""Steps that are recorded once on a GPU and then replayed, without Python and launches in between.

A step is a function without arguments: what it reads and changes are tensors that stay where they
are, and it asks the host for nothing. Torch and Warp work in one stream, so that the recording (a
CUDA graph) holds the work of both.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

import torch

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
