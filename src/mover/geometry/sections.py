"""How deep a place lies in a solid, by the horizontal way out of it.

Furniture stands on the floor: what stands in a table top cannot leave through its thickness. So the
depth is measured within the horizontal section of the solid at the height of the place. 20 cm from
the edge of a table top it is 20 cm, however thin the top; below the top it is nothing.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.geometry.crops import depth_in
from mover.geometry.nearest import as_float64, as_int64
from mover.geometry.volume import Volume, outward, sample, winding

WIDE = 96  # cells along the longest horizontal side, at most
CELL = 0.01  # [m], the smallest cell
RISE = 0.005  # [m] from section to section, at least
MOST = 2000  # sections of a solid
AROUND = 2  # cells outside, on every side


@record
class Sections:
    """Horizontal sections of a solid, in its own frame."""

    outline: Volume
    """Signed distance to the outline of the section at each height [m], negative inside; heights
    are stretched, so that cells are cubes."""
    stretch: float  #: by what


def sections_of(verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"]) -> Sections:
    """The sections of a closed mesh of one orientation; half a cell is how well they are known."""
    points, triangles = as_float64(verts), as_int64(faces)
    low, high = points.min(0), points.max(0)
    cell = max(float((high - low)[[0, 2]].max()) / WIDE, CELL)
    rise = max(float(high[1] - low[1]) / MOST, RISE)
    edges = np.array([cell, rise, cell])
    counts = np.ceil((high - low) / edges).astype(np.int64) + 2 * AROUND
    first = (low + high) / 2 - edges * (counts - 1) / 2
    inside = winding((points - first) / edges, outward(points, triangles), counts) > 0
    stretch = cell / rise
    return Sections(
        Volume(
            torch.from_numpy(_outlines(inside, cell)).to(verts),
            torch.from_numpy(first * [1.0, stretch, 1.0]).to(verts),
            cell,
        ),
        stretch,
    )


def outline(sections: Sections, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Signed distance to the outline of the section nearest in height to each point [m].

    The gradient is horizontal: nothing grows or shrinks out of a position.
    """
    volume = sections.outline
    x, y, z = points.unbind(-1)
    first = volume.origin[1].to(y)
    number = ((y.detach() * sections.stretch - first) / volume.cell).round()
    return sample(volume, torch.stack([x, first + volume.cell * number, z], -1))


def _outlines(inside: np.ndarray, cell: float) -> np.ndarray:
    """Signed distance in each section, a cell outside at most [m]; half of it is uncertain."""
    found = np.full(inside.shape, cell, dtype=np.float32)
    known: dict[bytes, np.ndarray] = {}  # many sections of a piece are the same
    for height in np.flatnonzero(inside.any((0, 2))):
        section = np.ascontiguousarray(inside[:, height])
        key = section.tobytes()
        if key not in known:
            within, beyond = 0.5 - depth_in(section), depth_in(~section).clip(max=1.5) - 0.5
            known[key] = np.where(section, within, beyond) * cell
        found[:, height] = known[key]
    return found
