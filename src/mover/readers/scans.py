"""Scans of rooms and their floors."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..types import Mesh
from .fields import At
from .mesh_file import read_mesh

BIN = 0.02  # [m], of the histogram of heights
REACH = 0.6  # [m], the floor is so near to the lowest points
SHARE = 0.25  # of the fullest bin there: less is noise below the floor
OUTLIERS = 0.002  # share of the lowest points that may be anything


def read_scan(path: Path) -> Mesh:
    """A scan in the frame of its file.

    Raises:
        InputError: If it cannot be read.
    """
    return read_mesh(At(path.name, path.name), path.parent)[0]


def floor_of(heights: NDArray[np.float64]) -> float:
    """The height at which a scan has its lowest large level part [m].

    Args:
        heights: Of its vertices, upwards [m].
    """
    lowest = float(np.quantile(heights, OUTLIERS))
    near = heights[(heights >= lowest - BIN) & (heights <= lowest + REACH)]
    edges = np.arange(lowest - BIN, lowest + REACH + BIN, BIN)
    counts, _ = np.histogram(near, edges)
    full = int(np.flatnonzero(counts >= SHARE * counts.max())[0])
    best = full + int(counts[full : full + 3].argmax())
    close = near[np.abs(near - (edges[best] + BIN / 2)) <= BIN]
    return float(np.median(close)) if len(close) else float(edges[best] + BIN / 2)
