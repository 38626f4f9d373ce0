"""Who draws in a test: the kernels, or plain torch; see `drawn_by`."""

from contextlib import AbstractContextManager, nullcontext

import raster_torch
import torch

from mover.geometry.raster import warp
from mover.geometry.raster.engine import drawn_by, reference


def use_engine(name: str) -> AbstractContextManager[None]:
    """Inside the block "torch" or "warp" draws."""
    return drawn_by(raster_torch) if name == "torch" else nullcontext()


def drawer(verts_cam: torch.Tensor):
    """Torch for double precision, which the kernels do not have and tests of gradients need."""
    return reference() or (raster_torch if verts_cam.dtype == torch.float64 else warp)
