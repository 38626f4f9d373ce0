"""An order of points in which each next one is the farthest from those before."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor


def farthest_first(points: Float[Tensor, "points 3"], count: int) -> Int[Tensor, " count"]:
    """The first point, and so on the one that is farthest from all before; the first of equals."""
    x, y, z = np.ascontiguousarray(points.detach().cpu().float().numpy().T)
    chosen = np.zeros(count, dtype=np.int64)
    nearest = np.full(len(x), np.inf, dtype=np.float32)
    for row in range(1, count):
        at = chosen[row - 1]
        np.minimum(nearest, (x - x[at]) ** 2 + (y - y[at]) ** 2 + (z - z[at]) ** 2, out=nearest)
        chosen[row] = nearest.argmax()
    return torch.from_numpy(chosen).to(points.device)
