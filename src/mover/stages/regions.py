"""Which parts of furniture people touch (supplement, "Contact Regions of Objects").

Sofas and chairs are touched at the seat and the back, beds, tables and the rest on their top. The
parts follow from the normals of even surface points: up for seats and tops, forward for backs.
"""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..furniture.library import BACKS, SEATS
from ..records import record

UPRIGHT = 0.866  # cosine of 30 degrees: normals of a seat or a back in the `level` rule
STEEP = 0.966  # cosine of 15 degrees: the same in the release
LAYER = 0.05  # [m], thickness of the layer that is one seat


@record
class Regions:
    """Surface points that can be touched, in the object's frame [m]."""

    top: Float[Tensor, "tops 3"]
    back: Float[Tensor, "backs 3"]
    has_top: bool
    has_back: bool


def find_regions(
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    category: str,
    rule: Literal["level", "release"],
) -> Regions:
    """Seat or top, and back, of one object.

    `level`: the seat is the largest level layer above a quarter of the height, so that neither
    arms nor the back's rim count; a top is the highest layer with a quarter of the largest one's
    area. `release`: normals within 15 degrees above a third of the height; of those, chairs, sofas
    and beds keep the points below the mean height, others those above it.
    """
    if rule == "release":
        top, back = _by_means(points, normals, category)
    else:
        top = _level(points, normals, category)
        back = _behind(points, normals, points[top])
    if category not in BACKS:
        back = torch.zeros_like(back)
    return Regions(points[top], points[back], bool(top.any()), bool(back.any()))


def _level(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], category: str
) -> Bool[Tensor, " points"]:
    y = points[:, 1]
    height = float(y.max())
    facing = (normals[:, 1] > UPRIGHT) & (y > 0.25 * height)
    layers = torch.arange(0.0, height + LAYER, LAYER / 2)
    inside = facing & ((y - layers.unsqueeze(-1)).abs() <= LAYER)
    area = inside.sum(-1)
    if category in SEATS or category == "bed":
        return inside[area.argmax()]
    wide = (area >= 0.25 * area.max()) & (area > 0)
    return inside[wide.nonzero()[-1, 0]] if wide.any() else facing


def _behind(
    points: Float[Tensor, "points 3"],
    normals: Float[Tensor, "points 3"],
    seat: Float[Tensor, "seat 3"],
) -> Bool[Tensor, " points"]:
    if len(seat) == 0:
        return torch.zeros(len(points), dtype=torch.bool)
    above = points[:, 1] > seat[:, 1].mean() + LAYER
    return (normals[:, 2] > UPRIGHT) & above & (points[:, 2] < seat[:, 2].mean())


def _by_means(
    points: Float[Tensor, "points 3"], normals: Float[Tensor, "points 3"], category: str
) -> tuple[Bool[Tensor, " points"], Bool[Tensor, " points"]]:
    y, z = points[:, 1], points[:, 2]
    high = y > y.max() / 3
    top, back = high & (normals[:, 1] > STEEP), high & (normals[:, 2] > STEEP)
    if top.any():
        mean = y[top].mean()
        below = category in ("chair", "sofa", "bed")
        top = top & ((y <= mean) if below else (y >= mean))
    if back.any():
        back = back & (z <= z[back].mean())
    return top, back
