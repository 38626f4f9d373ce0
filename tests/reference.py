"""Who draws in a test: the kernels, or plain torch; see `drawn_by`."""

from contextlib import AbstractContextManager, nullcontext
from types import ModuleType

import raster_torch
import torch

from mover.geometry import raster
from mover.geometry.raster import drawn_by


def use_engine(name: str) -> AbstractContextManager[None]:
    """Inside the block "torch" or "warp" draws."""
    return drawn_by(raster_torch) if name == "torch" else nullcontext()


def reference_of(verts_cam: torch.Tensor) -> ModuleType | None:
    """Torch for double precision, which the kernels do not have and tests of gradients need."""
    return raster_torch if verts_cam.dtype == torch.float64 else raster._reference.get()
