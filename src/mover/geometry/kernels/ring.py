# pyright: basic, reportInvalidTypeForm=false
"""The ring around what is kept of a silhouette: its price and how that changes (`release`)."""

from typing import no_type_check

import warp as wp

from .contour import pull_cut
from .panes import Bench, Bill, Panes


@wp.func
@no_type_check
def keep_image(p: Panes, b: Bench, item: int, box: wp.vec4i) -> None:
    """Forget what is not kept, and find the highest pixel of the row around each."""
    there = item % p.objects * p.pixels
    width = b.scene.width - 2 * b.scene.border
    first = wp.max(box[2] - p.ring, 0)
    stop = wp.min(box[3] + p.ring, width)
    for row in range(box[0], box[1]):
        start = row * width
        for place in range(start + box[2], start + box[3]):
            b.image[place] = b.image[place] * p.keep[there + place]
        for column in range(first, stop):
            most = b.image[start + column]
            if most < 1.0:
                left = wp.max(column - p.ring, 0)
                for k in range(start + left, start + wp.min(column + p.ring + 1, width)):
                    most = wp.max(most, b.image[k])
            b.rows[start + column] = most


@wp.func
@no_type_check
def source(p: Panes, b: Bench, rows: wp.vec2i, column: int, most: float) -> int:
    """The first pixel around a column, row by row, that has the highest level."""
    width = b.scene.width - 2 * b.scene.border
    row = rows[0]
    while row < rows[1] - 1 and b.rows[row * width + column] != most:
        row += 1
    place = row * width + wp.max(column - p.ring, 0)
    while b.image[place] != most:
        place += 1
    return place


@wp.func
@no_type_check
def price_ring(p: Panes, b: Bench, bill: Bill, item: int, box: wp.vec4i) -> None:
    """The weighted ring around what is kept of the silhouette."""
    there = item % p.objects * p.pixels
    width = b.scene.width - 2 * b.scene.border
    height = b.scene.height - 2 * b.scene.border
    total = wp.float64(0.0)
    for row in range(wp.max(box[0] - p.ring, 0), wp.min(box[1] + p.ring, height)):
        rows = wp.vec2i(wp.max(row - p.ring, box[0]), wp.min(row + p.ring + 1, box[1]))
        for column in range(wp.max(box[2] - p.ring, 0), wp.min(box[3] + p.ring, width)):
            place = row * width + column
            own = b.image[place]
            if own < 1.0:
                most = own
                for other in range(rows[0], rows[1]):
                    most = wp.max(most, b.rows[other * width + column])
                if most > own:
                    weight = p.weight[there + place]
                    total += wp.float64(weight * (most - own))
                    origin = source(p, b, rows, column, most)
                    b.slope[origin] = b.slope[origin] + weight
                    b.slope[place] = b.slope[place] - weight
    bill.price[item, 1] = wp.float32(total)


@wp.func
@no_type_check
def pull_ring(p: Panes, b: Bench, item: int) -> None:
    """Change of the ring with the vertices."""
    there = item % p.objects * p.pixels
    for i in range(b.scratch.count[1]):
        place = b.scratch.targets[i]
        if place >= 0:
            change = b.slope[place] * p.keep[there + place]
            if change != 0.0:
                pull_cut(b.scene, b.scratch.cuts[i], change, b.rings)
