# pyright: basic, reportInvalidTypeForm=false
"""The prices of drawn windows and their gradients, for one item after the other: for CPUs.

What is drawn is that of `items`; it stays in the cache until it is priced, and no map is kept.
"""

from typing import no_type_check

import warp as wp

from .contour import pull_cut
from .items import FAR, NOWHERE, clamp_cuts, draw, enter_cuts, keep_cuts, project
from .panes import BOUNDED, FREE, Bench, Bill, Panes
from .ring import keep_image, price_ring, pull_ring
from .scene import Scene
from .surface import face_of, inverse_depth, pull_depth

wp.set_module_options({"enable_backward": False, "fuse_fp": False, "optimization_level": 3})


@wp.func
@no_type_check
def load(whole: Scene, b: Bench, item: int) -> None:
    """Put an item on the bench."""
    shape = item % whole.shapes
    b.scene.window[0] = whole.window[item % whole.views]
    for v in range(whole.n_verts):
        b.scene.verts[v] = whole.verts[item * whole.n_verts + v]
    for f in range(whole.n_faces):
        b.scene.faces[f] = whole.faces[shape * whole.n_faces + f]
    for e in range(whole.n_edges):
        b.scene.edges[e] = whole.edges[shape * whole.n_edges + e]


@wp.func
@no_type_check
def shown(b: Bench, box: wp.vec4i) -> wp.vec4i:
    """The part of a box that is in the window, in its rows and columns."""
    edge = b.scene.border
    return wp.vec4i(
        wp.max(box[0] - edge, 0),
        wp.min(box[1] - edge, b.scene.height - 2 * edge),
        wp.max(box[2] - edge, 0),
        wp.min(box[3] - edge, b.scene.width - 2 * edge),
    )


@wp.func
@no_type_check
def covered(b: Bench, row: int, column: int) -> bool:
    """Whether a front and a back are seen at a pixel."""
    grid = (row + b.scene.border) * b.scene.width + column + b.scene.border
    return b.scratch.near[grid] != wp.uint64(0) and b.scratch.far[grid] != wp.uint64(0)


@wp.func
@no_type_check
def solid(b: Bench, row: int, column: int, steps: int) -> bool:
    """Whether all that is so many steps away is covered; the window's border is no edge."""
    height = b.scene.height - 2 * b.scene.border
    width = b.scene.width - 2 * b.scene.border
    for other in range(wp.max(row - steps, 0), wp.min(row + steps + 1, height)):
        reach = steps - wp.abs(other - row)
        for place in range(wp.max(column - reach, 0), wp.min(column + reach + 1, width)):
            if not covered(b, other, place):
                return False
    return True


@wp.func
@no_type_check
def price_bounds(p: Panes, b: Bench, pixel: wp.vec3i, known: int, near: wp.uint64) -> float:
    """How far the depths of a pixel (row, column, place) are out of bounds inside the mask."""
    z = 1.0 / inverse_depth(near, False)
    last = z
    back = face_of(near)
    if p.back:
        far = b.scratch.far[(pixel[0] + b.scene.border) * b.scene.width + pixel[1] + b.scene.border]
        last = 1.0 / inverse_depth(far, True)
        back = face_of(far)
    short = p.near[known] - z
    over = last - p.far[known]
    below = short > 0.0 and wp.isfinite(short)
    above = over > 0.0 and wp.isfinite(over)
    price = float(0.0)
    if below or above:
        if solid(b, pixel[0], pixel[1], p.shrink[0]):
            if below:
                price += wp.min(short, p.limit[0])
                if short <= p.limit[0]:
                    pull_depth(b.scene, pixel[2], face_of(near), z, -1.0, b.bounds)
            if above:
                price += wp.min(over, p.limit[0])
                if over <= p.limit[0]:
                    pull_depth(b.scene, pixel[2], back, last, 1.0, b.bounds)
    return price


@wp.func
@no_type_check
def price_free(p: Panes, b: Bench, pixel: wp.vec3i, known: int, near: wp.uint64) -> float:
    """How far a pixel is in front of free space outside the mask."""
    z = 1.0 / inverse_depth(near, False)
    short = p.free[known] - z
    if short > 0.0 and wp.isfinite(short):
        if solid(b, pixel[0], pixel[1], p.shrink[1]):
            if short <= p.limit[1]:
                pull_depth(b.scene, pixel[2], face_of(near), z, -1.0, b.frees)
            return wp.min(short, p.limit[1])
    return 0.0


@wp.func
@no_type_check
def price_depths(p: Panes, b: Bench, bill: Bill, item: int, box: wp.vec4i) -> None:
    """The prices of the depths."""
    bounds = wp.float64(0.0)
    free = wp.float64(0.0)
    there = item % p.objects * p.pixels
    width = b.scene.width - 2 * b.scene.border
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            place = row * width + column
            rule = p.rules[there + place]
            if rule != wp.uint8(0) and covered(b, row, column):
                pixel = wp.vec3i(row, column, place)
                near = b.scratch.near[
                    (row + b.scene.border) * b.scene.width + column + b.scene.border
                ]
                if rule == BOUNDED:
                    bounds += wp.float64(price_bounds(p, b, pixel, there + place, near))
                if rule == FREE:
                    free += wp.float64(price_free(p, b, pixel, there + place, near))
    bill.price[item, 2] = wp.float32(bounds)
    bill.price[item, 3] = wp.float32(free)


@wp.func
@no_type_check
def show(b: Bench, box: wp.vec4i) -> None:
    """Write the image, forget the winners, and move the image by the outline."""
    edge = b.scene.border
    width = b.scene.width - 2 * edge
    height = b.scene.height - 2 * edge
    for row in range(box[0], box[1]):
        inside = row >= edge and row < height + edge
        for column in range(box[2], box[3]):
            grid = row * b.scene.width + column
            if (b.scratch.near[grid] | b.scratch.far[grid]) != wp.uint64(0):
                if inside and column >= edge and column < width + edge:
                    if b.scratch.near[grid] != wp.uint64(0):
                        b.image[(row - edge) * width + column - edge] = 1.0
                b.scratch.near[grid] = wp.uint64(0)
                b.scratch.far[grid] = wp.uint64(0)
    keep_cuts(b.scene, b.scratch, b.maps, 0)
    clamp_cuts(b.scratch, b.maps)


@wp.func
@no_type_check
def price_squares(p: Panes, b: Bench, bill: Bill, item: int, box: wp.vec4i) -> None:
    """The sum of the kept squared differences."""
    thing = item % p.objects
    there = thing * p.pixels
    total = p.empty[thing]
    width = b.scene.width - 2 * b.scene.border
    for row in range(box[0], box[1]):
        for place in range(row * width + box[2], row * width + box[3]):
            drawn = b.image[place]
            if drawn != 0.0:
                gain = p.keep[there + place] * drawn * (drawn - 2.0 * p.mask[there + place])
                total += wp.float64(gain)
    bill.price[item, 0] = wp.float32(total)
    for i in range(b.scratch.count[1]):
        place = b.scratch.targets[i]
        if place >= 0:
            change = 2.0 * p.keep[there + place] * (b.image[place] - p.mask[there + place])
            pull_cut(b.scene, b.scratch.cuts[i], change, b.squares)


@wp.func
@no_type_check
def clear(p: Panes, b: Bench, box: wp.vec4i) -> None:
    """Forget the image and the change of the ring."""
    width = b.scene.width - 2 * b.scene.border
    height = b.scene.height - 2 * b.scene.border
    for row in range(wp.max(box[0] - p.ring, 0), wp.min(box[1] + p.ring, height)):
        first = row * width + wp.max(box[2] - p.ring, 0)
        for place in range(first, row * width + wp.min(box[3] + p.ring, width)):
            b.image[place] = 0.0
            b.slope[place] = 0.0


@wp.func
@no_type_check
def hand_over(b: Bench, bill: Bill, item: int) -> None:
    """Write the gradients and forget them."""
    zero = wp.vec3(0.0, 0.0, 0.0)
    for v in range(b.scene.n_verts):
        bill.grads[item, 0, v] = b.squares[v]
        bill.grads[item, 1, v] = b.rings[v]
        bill.grads[item, 2, v] = b.bounds[v]
        bill.grads[item, 3, v] = b.frees[v]
        b.squares[v] = zero
        b.rings[v] = zero
        b.bounds[v] = zero
        b.frees[v] = zero


@wp.kernel
@no_type_check
def price_windows(whole: Scene, p: Panes, b: Bench, bill: Bill, part: wp.vec2i) -> None:
    """Draw and price some items: the first, and the one after the last."""
    for item in range(part[0], part[1]):
        load(whole, b, item)
        box = project(b.scene, b.scratch, 0)
        draw(b.scene, b.scratch, 0, wp.where(p.depth, FAR, NOWHERE))
        enter_cuts(b.scene, b.scratch, 0)
        window = shown(b, box)
        bill.price[item, 1] = 0.0
        bill.price[item, 2] = 0.0
        bill.price[item, 3] = 0.0
        if p.depth:
            price_depths(p, b, bill, item, window)
        show(b, box)
        price_squares(p, b, bill, item, window)
        if p.ring > 0:
            keep_image(p, b, item, window)
            price_ring(p, b, bill, item, window)
            pull_ring(p, b, item)
        clear(p, b, window)
        hand_over(b, bill, item)
