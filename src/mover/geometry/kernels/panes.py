# pyright: basic, reportInvalidTypeForm=false, reportGeneralTypeIssues=false
"""What the windows of the objects know, and the memory of a thread that prices one of them."""

from typing import no_type_check

import warp as wp

from .scene import Maps, Scene, Scratch

BOUNDED = wp.constant(wp.uint8(1))  # of the rules
FREE = wp.constant(wp.uint8(2))


@wp.struct
@no_type_check
class Panes:
    """Evidence in the windows, flat over objects, rows, columns; starts repeat the objects."""

    pixels: int
    """Of a window."""
    objects: int
    mask: wp.array(dtype=wp.float32)
    keep: wp.array(dtype=wp.float32)
    """1 or 0."""
    empty: wp.array(dtype=wp.float64)
    """Price of each window in which nothing is drawn."""
    weight: wp.array(dtype=wp.float32)
    """Of the ring around the silhouette; nothing where `ring` is 0."""
    ring: int
    """How far the ring reaches [px]."""
    rules: wp.array(dtype=wp.uint8)
    """Which bounds may hold at a pixel: BOUNDED, FREE; nothing where no depth is asked for."""
    near: wp.array(dtype=wp.float32)
    """Lower bound inside the mask [m]."""
    far: wp.array(dtype=wp.float32)
    """Upper bound inside the mask [m]."""
    free: wp.array(dtype=wp.float32)
    """Lower bound outside the mask [m]."""
    depth: bool
    """Whether depths are asked for."""
    back: bool
    """The upper bound is that of the farthest surface, else of the nearest."""
    limit: wp.vec2
    """Most that a pixel can be out of bounds, for BOUNDED and FREE [m]."""
    shrink: wp.vec2i
    """Steps to the four neighbours by which what is drawn shrinks, for both."""


@wp.struct
@no_type_check
class Bench:
    """Working memory for one item; all that is flat over pixels is zero in between."""

    scene: Scene
    """The item alone."""
    scratch: Scratch
    image: wp.array(dtype=wp.float32)
    maps: Maps
    """Of the image alone."""
    rows: wp.array(dtype=wp.float32)
    """The highest pixel of the row around each; anything."""
    slope: wp.array(dtype=wp.float32)
    """Change of the ring with each pixel."""
    squares: wp.array(dtype=wp.vec3)
    """Change of each price with the vertices."""
    rings: wp.array(dtype=wp.vec3)
    bounds: wp.array(dtype=wp.vec3)
    frees: wp.array(dtype=wp.vec3)


@wp.struct
@no_type_check
class Bill:
    """What the items cost: squares, ring, bounds, free space; and how that changes."""

    price: wp.array2d(dtype=wp.float32)
    grads: wp.array3d(dtype=wp.vec3)
    """Items, prices, vertices."""
