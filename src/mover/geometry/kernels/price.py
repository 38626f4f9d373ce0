# pyright: basic, reportInvalidTypeForm=false
"""Warp kernels that price rows of pixels and keep the slope of the price."""

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.struct
@no_type_check
class Bounds:
    """What depths are allowed, flat over items, rows, columns; starts repeat the items."""

    mask: wp.array(dtype=wp.float32)
    near: wp.array(dtype=wp.float32)
    far: wp.array(dtype=wp.float32)
    width: int
    """Columns of a row."""
    first: int
    """The first row that is priced."""
    margin: float
    """Slack of both bounds [m]."""
    limit: float
    """Most that a pixel can be outside [m]."""


@wp.kernel
@no_type_check
def outside_rows(
    depth: wp.array(dtype=wp.float32),
    covered: wp.array(dtype=wp.bool),
    bounds: Bounds,
    price: wp.array(dtype=wp.float32),
    count: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=wp.float32),
) -> None:
    """How far the depths of a row are out of their bounds, how many are bounded, and the slope."""
    row = bounds.first + wp.tid()
    start = row * bounds.width
    other = start % bounds.mask.shape[0]
    total = wp.float32(0.0)
    number = wp.float32(0.0)
    for column in range(bounds.width):
        if covered[start + column]:
            near = bounds.near[other + column]
            far = bounds.far[other + column]
            bounded = near < far and (wp.isfinite(near) or wp.isfinite(far))
            if bounded and bounds.mask[other + column] > 0.5:
                number += 1.0
                z = depth[start + column]
                short = wp.where(wp.isfinite(near), near - bounds.margin - z, 0.0)
                over = wp.where(wp.isfinite(far), z - far - bounds.margin, 0.0)
                total += wp.clamp(short, 0.0, bounds.limit) + wp.clamp(over, 0.0, bounds.limit)
                down = wp.where(short > 0.0 and short < bounds.limit, 1.0, 0.0)
                up = wp.where(over > 0.0 and over < bounds.limit, 1.0, 0.0)
                slope[start + column] = up - down
    price[row] = total
    count[row] = number
