"""What draws in a test: the kernels, or plain torch."""

from collections.abc import Generator
from contextlib import contextmanager
from types import ModuleType

import pytest
import raster_torch
import torch

from mover.energy.fused import energy
from mover.geometry import raster


@contextmanager
def use_engine(name: str) -> Generator[None, None, None]:
    """Inside the block "torch" or "warp" draws and sums."""
    with pytest.MonkeyPatch.context() as patch:
        if name == "torch":
            patch.setattr(raster, "_reference_of", lambda _: raster_torch)
            patch.setattr(energy, "fused_energy", lambda *_: None)
        yield


@contextmanager
def use_threads(count: int) -> Generator[None, None, None]:
    """Let so many threads draw inside the block (or the decorated function)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", str(count))
        yield


def reference_of(verts_cam: torch.Tensor) -> ModuleType | None:
    """Torch for double precision, which the kernels do not have and tests of gradients need."""
    return raster_torch if verts_cam.dtype == torch.float64 else None
