r"""How far away upright people are: their height in the image less the width of their head.

Not in the paper. A mask that is too wide by a few pixels all round adds as much to the height as to
the width of everything in it: the difference of both does not know it. An error of the pose, which
lowers the overlap of body and mask and so makes smaller, farther bodies look better, changes the
height of somebody upright by its square only.

    factor = median over frames of  (h_body - w_body) / (h_mask - w_mask)
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry.camera import project
from ..geometry.raster import Views, layers
from ..geometry.runs import decode
from ..types import Bodies, Camera, Masks
from .person_masks import MaskTable

WHOLE = 0.01  # of the body's picture may be covered by objects or others, and no more
UPRIGHT = 1.8  # times as high as wide
HEAD = 0.125  # of the height
HIGH = 100.0  # [px]; of smaller people a pixel is more than a percent
GAUSS = 1.4826  # standard deviation over the median of absolute deviations


@dataclass(frozen=True)
class Extents:
    """What the heights of one person say."""

    factor: float
    """True depth over the given one."""
    spread: float
    """Standard deviation of `factor`."""
    frames: int
    """How many showed the person wholly."""


def compare_extents(
    bodies: Bodies,
    rows: Int[Tensor, " rows"],
    camera: Camera,
    table: MaskTable,
    blocked: Bool[Tensor, "h w"],
) -> Extents | None:
    """Compare the heights of bodies that are wholly seen with those of their masks.

    Args:
        bodies: In camera axes.
        rows: Bodies of one person.
        camera: Its image has the size of the masks.
        table: The person's masks.
        blocked: Pixels of what may hide people.

    Returns:
        None if nobody is seen wholly, upright and high enough.
    """
    ratios: list[float] = []
    for row in rows.tolist():
        if not _inside(bodies.verts[row], camera):
            continue
        drawn = _drawn(bodies, row, camera)
        high, wide = _extent(drawn)
        if high <= UPRIGHT * wide:
            continue
        own, others = table.decode(row)
        covered = drawn & (blocked | others) & ~own
        if covered.sum() <= WHOLE * drawn.sum() and min(high, _extent(own)[0]) >= HIGH:
            body, mask = high - _thick(drawn), _extent(own)[0] - _thick(own)
            ratios.append(body / mask if mask > 0 else math.nan)
    found = torch.tensor([r for r in ratios if math.isfinite(r)], dtype=torch.float64)
    if not len(found):
        return None
    middle = found.median()
    off = GAUSS * float((found - middle).abs().median())
    return Extents(float(middle), 1.25 * off / len(found) ** 0.5, len(found))


def pixels_of(masks: Masks) -> Bool[Tensor, "h w"]:
    """The pixels that are in any of some masks."""
    covered = torch.zeros(masks.height, masks.width, dtype=torch.bool)
    for row in range(len(masks.counts)):
        covered = covered | decode(masks, row)
    return covered


def _inside(verts: Float[Tensor, "verts 3"], camera: Camera) -> bool:
    pixels = project(verts, camera.K.to(verts))
    last = pixels.new_tensor([camera.width - 2, camera.height - 2])
    ahead = bool((verts[:, 2] > 0).all())
    return ahead and bool(((pixels > 2) & (pixels < last)).all())


def _drawn(bodies: Bodies, row: int, camera: Camera) -> Bool[Tensor, "h w"]:
    views = Views(camera.K[None].float(), camera.height, camera.width)
    return layers(bodies.verts[row : row + 1].float(), bodies.faces, views).front.isfinite()[0]


def _extent(mask: Bool[Tensor, "h w"]) -> tuple[float, float]:
    """Height and width of what is set [px]."""
    ends = [torch.nonzero(mask.any(axis))[:, 0] for axis in (1, 0)]
    high, wide = (float(e[-1] - e[0] + 1) if len(e) else 0.0 for e in ends)
    return high, wide


def _thick(mask: Bool[Tensor, "h w"]) -> float:
    """Width of the head [px]: of the largest disc in the top of what is set."""
    from scipy.ndimage import distance_transform_edt

    rows = torch.nonzero(mask.any(1))[:, 0]
    if not len(rows):
        return 0.0
    high = int(rows[-1] - rows[0]) + 1
    top = mask[rows[0] : rows[0] + max(3, round(HEAD * high))]
    padded = torch.nn.functional.pad(top, [1, 1, 1, 0])
    return 2 * float(np.max(np.asarray(distance_transform_edt(padded.numpy())))) - 1
