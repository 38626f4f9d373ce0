"""What the kernel of Eq. 1 knows of the objects, its working memory, and what it answers."""

import warp as wp

from mover.geometry.kernels.lookup import Field
from mover.geometry.kernels.scene import Items, Scratch

BBOX, SILHOUETTE, SCALE, DEPTH, COLLISION, CONTACT, DISTANCE, HEADING = range(8)
VERTS, FACES, EDGES, SAMPLES, QUERIES = range(5)  # columns of `Things.starts`
SIZE, BUMP, AWAY, FACE_X, FACE_Z, SEATED = range(6)  # columns of `Given.facts`

Slope = wp.types.vector(length=9, dtype=wp.float32)
"""Gradient of a place (3), of the yaw, of the logarithms of the scale (3), of turns about x, z."""
Weights = wp.types.vector(length=8, dtype=wp.float32)


@wp.struct
class ObjectData:
    """The objects one after the other, without padding; numbers count within an object."""

    verts: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    edges: wp.array(dtype=wp.vec4i)
    """Two vertices, the face that runs from the first to the second, and the one that does not."""
    samples: wp.array(dtype=wp.vec3)
    starts: wp.array2d(dtype=wp.int32)
    """Where each object begins, and where the last one ends, in each of the lists."""


@wp.struct
class ImageData:
    """What the image says, on grids with a border, in which nothing is known."""

    lens: wp.array(dtype=wp.vec4)
    """Focal lengths and principal point of each window, with the border [px]."""
    shifts: wp.array(dtype=wp.float32)
    """By how much outlines may be off, see `image_terms` [px of the image]; `mask`, `gain`,
    `empty` and `trust` are by shift, then by object."""
    mask: wp.array(dtype=wp.float32)
    gain: wp.array(dtype=wp.float64)
    """What the cost changes by when all pixels of a row before this one are covered."""
    empty: wp.array(dtype=wp.float64)  #: cost of each window in which nothing is drawn
    trust: wp.array(dtype=wp.float32)  #: weight of each silhouette
    loose: float  #: cost of the square of a shift [1/px^2]
    keep: wp.array(dtype=wp.float32)
    lower: wp.array(dtype=wp.float32)
    """Lowest depth, with its slack; infinite where a pixel has no bound at all [m]."""
    upper: wp.array(dtype=wp.float32)  #: highest depth, with its slack [m]
    bounded: wp.array(dtype=wp.vec4i)
    """Rows and columns in which depths are bounded, as in `cover.ScreenExtent`."""
    limit: float  #: most that a depth can be out of its bounds [m]
    fewest: float  #: pixels by which depths are divided at least


@wp.struct
class HumanData:
    """What the people say."""

    field: Field
    queries: wp.array(dtype=wp.vec3)  #: skin that touches, in the world [m]
    share: wp.array(dtype=wp.float32)
    """Its share in the cost of its object; negative: it touches the back."""
    rho: float  #: distance at which contact costs a half [m]
    top: wp.array2d(dtype=wp.vec3)
    back: wp.array2d(dtype=wp.vec3)


@wp.struct
class KernelInput:
    """Everything that stays as it is while the objects move."""

    things: ObjectData
    windows: ImageData
    people: HumanData
    boxes: wp.array(dtype=wp.vec4)  #: detected boxes [px]
    within: wp.array(dtype=wp.vec4)  #: whether a side is known, and costs
    beyond: wp.array(dtype=wp.vec4)  #: the most that it costs to stick out of a side
    facts: wp.array2d(dtype=wp.float32)
    turn: wp.array(dtype=wp.mat33)  #: from the world to the camera; one
    lens: wp.vec4  #: focal lengths and principal point of the image [px]
    weights: Weights
    soft: float  #: half width of the rounded tip of the cost of a box
    sizes: wp.vec2  #: logarithms of the lowest and highest scale that are usual
    growth: float  #: cost of another size as a whole, against another shape
    rho: float  #: change of the logarithm of the distance that costs a half


@wp.struct
class Workspace:
    """Working memory of a thread, for one item at a time; all but the lists is zero in between."""

    scene: Items  #: an item alone: its vertices in camera axes and its window
    scratch: Scratch
    steps: wp.array(dtype=wp.uint8)
    """Change of the number of layers from pixel to pixel, modulo 256."""
    words: wp.array(dtype=wp.uint64)  #: the same memory, eight at a time
    seen: wp.array(dtype=wp.uint64)  #: a bit for each pixel at which a front is seen
    behind: wp.array(dtype=wp.uint64)  #: a bit for each pixel at which a back is
    stride: int  #: steps of a row, a multiple of eight
    across: int  #: words of a row of bits
    pairs: wp.array(dtype=wp.int32)  #: pair of centres of each cut that may count
    keys: wp.array(dtype=wp.uint64)  #: its key
    crossings: wp.array(dtype=wp.vec4)
    """Of each cut that counts: share, slope, direction outward, 1 where its pixel is covered."""
    shift: wp.array(dtype=wp.float32)  #: what the outline adds to a pixel
    moved: wp.array(dtype=wp.float32)  #: the same for the pixel of each cut that counts
    squares: wp.array(dtype=wp.float64)  #: sum of the squares of the silhouette under each shift


@wp.struct
class ItemCosts:
    """Costs of the items, with their weights, and how they change."""

    order: wp.array(dtype=wp.int32)  #: in which order the items are taken
    layout: wp.array2d(dtype=wp.float32)  #: place, yaw, logarithms of the scale of each item
    parts: wp.array2d(dtype=wp.float32)  #: each term of each item
    slopes: wp.array(dtype=Slope, ndim=2)
    whole: wp.array(dtype=wp.float32)  #: sum of the terms
    slope: wp.array(dtype=Slope)


@wp.struct
class Pose:
    """Where an item stands; vectors in its own axes have its size but not its place."""

    item: int
    thing: int  #: the object that it is
    scale: wp.vec3
    turn: wp.mat33  #: from its own axes to the world
    place: wp.vec3  #: in the world [m]
    view: wp.mat33  #: from its own axes to the camera
    origin: wp.vec3  #: in camera axes [m]


@wp.func
def pose_of(data: KernelInput, layout: wp.array2d(dtype=wp.float32), item: int) -> Pose:
    """The pose of a row of the layout."""
    p = Pose()
    p.item = item
    p.thing = item % (data.things.starts.shape[0] - 1)
    c = wp.cos(layout[item, 3])
    s = wp.sin(layout[item, 3])
    p.turn = wp.mat33(c, 0.0, s, 0.0, 1.0, 0.0, -s, 0.0, c)
    p.place = wp.vec3(layout[item, 0], layout[item, 1], layout[item, 2])
    p.scale = wp.vec3(wp.exp(layout[item, 4]), wp.exp(layout[item, 5]), wp.exp(layout[item, 6]))
    p.view = data.turn[0] * p.turn
    p.origin = data.turn[0] * p.place
    return p


@wp.func
def slope_of(force: wp.vec3, arm: wp.vec3) -> Slope:
    """How a cost changes with the pose, from its change with a point, all in the item's axes."""
    turn = wp.cross(arm, force)
    size = wp.cw_mul(force, arm)
    return Slope(force[0], force[1], force[2], turn[1], size[0], size[1], size[2], turn[0], turn[2])


@wp.func
def accumulate(answer: ItemCosts, p: Pose, term: int, cost: float, slope: Slope) -> None:
    """Enter a term, with its weight; the slopes of place and turns are in the item's axes."""
    t = p.turn * wp.vec3(slope[0], slope[1], slope[2])
    r = p.turn * wp.vec3(slope[7], 0.0, slope[8])
    s = Slope(t[0], t[1], t[2], slope[3], slope[4], slope[5], slope[6], r[0], r[2])
    answer.parts[p.item, term] = cost
    answer.slopes[p.item, term] = s
    answer.whole[p.item] = answer.whole[p.item] + cost
    answer.slope[p.item] = answer.slope[p.item] + s
