"""What is known of the furniture before it is seen: as given, of standard sizes, along axes."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.types import Heading, Layout, Objects
from mover.energy.human_terms import ContactPoints
from mover.energy.image_terms import LEAST, LIKELY, SEEN, UNKNOWN
from mover.energy.prior_terms import COMMON, SIZE, TURN, Given
from mover.furniture.library import SIZES, STANDARD, WALL_PIECES, WIDE_CLASSES, canonical
from mover.stages.config import SpreadConfig
from mover.stages.objects.own_edges import OwnEdges

FIT = 0.1  # image energy (robust form) of a shape that fits
PART, WHOLE = 0.2, 0.9  # shares of a side that something is near to, or touches
UNFIT = 0.5  # weight from which on a shape does not fit, or only as something hides it
WEIGHTS = (0.05, 2.0)  # least and largest weight
LOOSE = math.radians(8)  # how well the image alone turns objects of a weight of 1 [rad]
SQUARE = math.radians(5)  # how well furniture that stands along an axis does so [rad]
WALLS = 0.95  # chance that furniture runs along the edges that a picture shows
OFTEN, SELDOM = 0.9, 0.4  # chances that pieces along walls, and others, stand along an axis
CONTRADICTED = 3.0  # standard deviations between a given and a standard size, of another class
FIRM = 0.06  # spread of standards that hold for nearly all: mattresses are as long as people
STRAIGHT = math.radians(2)  # how well edges run along the sides of what they belong to [rad]
LEVEL, AGREES = 0.5, 0.95  # chances that an edge is level, and that what edges agree on is so
AGREED = math.radians(4)  # [rad], how well they must
DIRECTIONS = 90  # that are tried within a quarter turn


def gather_given(
    objects: Objects,
    start: Layout,
    layout: Layout,
    energy: Float[Tensor, " objects"],
    heading: Heading | None = None,
    edges: OwnEdges | None = None,
) -> Given:
    """The evidence of `prior_terms`.

    Args:
        objects: The furniture, as large as it was given.
        start: As it was given, in the world as it is known now.
        layout: Where it was placed since, by the image.
        energy: What is left of the image's energy there.
        heading: Of the room's walls, where they are seen.
        edges: Of the objects, where they are seen.
    """
    standard, precision, slack = standard_sizes(objects)
    along, known = chance_along(objects.categories), torch.ones_like(start.yaw)
    weight = prior_weights(energy)
    loose = (LOOSE * (0.1 + weight).sqrt()).clamp(SQUARE, TURN)
    observed = [(start.yaw, TURN * known, along), (layout.yaw, loose, along)]
    if heading is not None:
        yaw, off, sure = along.new_tensor([[heading.yaw], [heading.spread], [WALLS]])
        observed.append((yaw, off, sure))
    given = Given(
        distance=start.t_world_object.norm(dim=-1), yaw=start.yaw, along=known, sharpness=known,
        axis=known, standard=standard, precision=precision, slack=slack, weight=weight,
    )  # fmt: skip
    return _along_axes(given, along, room_axis(observed), edges)


def _along_axes(
    given: Given, along: Float[Tensor, " objects"], room: tuple[float, float],
    edges: OwnEdges | None,
) -> Given:  # fmt: skip
    """With the room's axis, and of objects whose own edges agree their own."""
    one = torch.ones_like(along)
    chance, axis, sharpness = along.clone(), room[0] * one, _sharpness(SQUARE, room[1]) * one
    if edges is not None:
        near = math.hypot(SQUARE, room[1]) * one
        spread = torch.hypot(edges.spread, torch.full_like(edges.spread, STRAIGHT))
        level = torch.full_like(edges.yaw, LEVEL)
        for k in edges.of.unique():
            mine, own = k.view(1), edges.of == k
            beside = (axis[mine], near[mine], along[mine])
            yaw, off = room_axis([beside, (edges.yaw[own], spread[own], level[own])])
            if off < AGREED:
                chance[k], axis[k], sharpness[k] = AGREES, yaw, _sharpness(STRAIGHT, off)
    like = given.weight
    return replace(given, along=chance.to(like), sharpness=sharpness.to(like), axis=axis.to(like))


def _sharpness(stands: float, off: float) -> float:
    """Of the density of yaws that stand so well along an axis which is so far off [rad]."""
    return 1 / (4 * math.hypot(stands, off)) ** 2


def chance_along(categories: Sequence[str]) -> Float[Tensor, " objects"]:
    """How probably each object stands along an axis of the room."""
    return torch.tensor([OFTEN if c in WALL_PIECES else SELDOM for c in categories])


def given_axis(categories: Sequence[str], heading: Heading, edges: OwnEdges | None = None) -> Given:
    """The same where nothing was given: of a room whose walls are seen, the axis alone."""
    along = chance_along(categories)
    return _along_axes(unplaced(len(along)), along, (heading.yaw, heading.spread), edges)


def unplaced(count: int) -> Given:
    """Nothing at all, of so many objects."""
    known, none = torch.ones(count), torch.zeros(count, 3)
    return Given(
        distance=known, yaw=0 * known, along=0 * known, sharpness=known, axis=0 * known,
        standard=none, precision=none, slack=none, weight=known, placed=False,
    )  # fmt: skip


def prior_weights(energy: Float[Tensor, " objects"]) -> Float[Tensor, " objects"]:
    """Weight of the guess of each object, by what the image leaves of it (`prior_terms`).

    A wrong shape can fit well where something hides half of it. So of an object that fits better
    than the room's usual one the geometric mean of both counts: shapes of one tool are similar.
    """
    usual = energy.median().clamp_min(1e-6)
    return (torch.where(energy < usual, (energy * usual).sqrt(), energy) / FIT).clamp(*WEIGHTS)


def lighter_where_used(
    given: Given, trust: Float[Tensor, " objects"], touches: ContactPoints | None
) -> Given:
    """The same, lighter for what people use: they say where it stands, whatever its outline."""
    if touches is None:
        return given
    index = touches.object_of
    less = given.weight[index] * trust[index]
    return replace(given, weight=given.weight.index_copy(0, index, less))


def bounded_sides(
    sides: Int[Tensor, "objects 4"],
    weight: Float[Tensor, " objects"],
    beside: Float[Tensor, "objects 4 2"] | None = None,
) -> Int[Tensor, "objects 4"]:
    """What is known of the sides of boxes, with no bound (`LIKELY`) for shapes that fit.

    An object that is cut off on the left may be higher and lower there than all that is seen of it:
    its top and its bottom are lower bounds, too. Its silhouette determines where it ends; a shape
    that does not fit would grow behind its occluder.

    Where shapes do not fit, masks are coarse, too: what is near to a side may hide more behind it,
    and what touches all of it does so about as often as not (`ImageCues.beside`).
    """
    fits = (weight < UNFIT).unsqueeze(-1)
    if beside is not None:
        near = (sides == SEEN) & (beside[..., 1] > PART)
        covered = (sides == LIKELY) & (beside[..., 0] > WHOLE)
        sides = torch.where(~fits & near, LIKELY, torch.where(~fits & covered, LEAST, sides))
    cut = (sides == LIKELY) | (sides == LEAST)
    cut = cut | cut.roll(1, -1) | cut.roll(-1, -1)  # or a side beside it is
    return torch.where(fits & cut & (sides != UNKNOWN), LEAST, sides)


MEANINGS = {canonical(name): kinds for name, kinds in WIDE_CLASSES.items()}
"""Of classes that detectors have one name for, the likeliest first."""


Sizes = tuple[Float[Tensor, "items 3"], Float[Tensor, "items 3"], Float[Tensor, "items 3"]]
"""`standard`, `precision` and `slack` of `Given`."""


def standard_sizes(objects: Objects) -> Sizes:
    """Standard sizes of objects that were given with their sizes.

    Detectors call a coffee table a dining table. So of the classes that have one name the first
    counts whose standard the given size does not contradict, and none where all are contradicted.
    """
    return _standards(objects.categories, objects.size, firm=False)


def sizes_of_shapes(categories: Sequence[str], sizes: Float[Tensor, "items 3"]) -> Sizes:
    """The same of shapes that may stand for things of a class: firm standards, and the limits.

    Of a class with several meanings (a dining table of COCO may be a desk or a coffee table) it is
    that which the size of the shape fits; of what is not firm the shape itself says as much, but
    nothing is larger or smaller than all of its class (`SIZES`), if its shape is not.
    """
    return _standards(categories, sizes, firm=True)


def _standards(categories: Sequence[str], sizes: Float[Tensor, "items 3"], *, firm: bool) -> Sizes:
    usual, sharp, slack = (torch.zeros_like(sizes) for _ in range(3))
    for i, (category, size) in enumerate(zip(categories, sizes, strict=True)):
        for name in MEANINGS.get(category, (category,)):
            known = [
                (axis, math.log(standard[0]) - size[axis].log(), standard[1])
                for axis, standard in enumerate(STANDARD.get(name, ()))
                if standard is not None
            ]
            fits = all(abs(x) < CONTRADICTED * math.hypot(s, SIZE, COMMON) for _, x, s in known)
            if fits or (firm and category not in MEANINGS):
                if firm and name in SIZES:
                    limits = torch.tensor(SIZES[name]).to(size).log() - size.log()[:, None]
                    low, high = limits[:, 0].clamp_max(0), limits[:, 1].clamp_min(0)
                    usual[i], slack[i], sharp[i] = (low + high) / 2, (high - low) / 2, FIRM**-2
                for axis, off, sigma in known:
                    if sigma <= FIRM or not firm:
                        usual[i, axis], slack[i, axis], sharp[i, axis] = off, 0, 1 / sigma**2
                break
    return usual, sharp, slack


def room_axis(
    said: Sequence[tuple[Float[Tensor, " _"], Float[Tensor, " _"], Float[Tensor, " _"]]],
) -> tuple[float, float]:
    """The direction along which most furniture stands, up to quarter turns, and its spread [rad].

    Args:
        said: Yaws of objects or walls with their spreads [rad] and the chance that each runs along
            it, from sources of their own.
    """
    tried = torch.arange(DIRECTIONS) * (math.pi / 2 / DIRECTIONS)
    chance = torch.zeros(DIRECTIONS)
    for yaw, spread, along in said:
        sharp = (1 / (4 * spread.cpu().float()) ** 2)[:, None]
        off = (4 * (yaw.cpu().float()[:, None] - tried)).cos() - 1
        density = (sharp * off).exp() / torch.special.i0e(sharp)
        chance += (1 - along[:, None] + along[:, None] * density).log().sum(0)
    weight = (chance - chance.max()).exp()
    weight = weight / weight.sum()
    x, y = float(weight @ (4 * tried).cos()), float(weight @ (4 * tried).sin())
    length = min(max(math.hypot(x, y), 1e-3), 1 - 1e-9)
    return math.atan2(y, x) / 4, math.sqrt(-2 * math.log(length)) / 4


WIDEST = 4.0  # largest spread that is learnt, in usual ones; the smallest is 1
LIGHTEST = 0.1  # of the weight of a silhouette that fits


def inlier_weights(energy: Float[Tensor, " objects"]) -> Float[Tensor, " objects"]:
    """Weights of the shapes of objects: 1 where the image can be made to fit.

    Args:
        energy: What is left of the image's energy (robust form) where each object fits best.
    """
    return (FIT / energy.clamp_min(1e-6)).clamp(LIGHTEST, 1)


def estimate_size_prior(
    layout: Layout, trust: Float[Tensor, " objects"], config: SpreadConfig
) -> tuple[float, float]:
    r"""Factors on the cost of another shape, and on that of another size as a whole.

    Not in the paper: where the image alone changes shapes more than usual, sizes that it cannot
    constrain are weighted less. Logarithms of an object's sizes are c + e_k with c common:

        \sum_k (l_k - m)^2 / v + 3 m^2 / (v + 3 w),   m = mean l_k,  v = var e_k,  w = var c,

    v is learnt from the room (empirical Bayes), in which shapes that do not fit count less.
    """
    if config.usual <= 0:
        return 1.0, 1.0
    log_scale, usual, share = layout.log_scale, config.usual**2, trust.square()
    shape = (log_scale - log_scale.mean(-1, keepdim=True)).square().sum(-1) / 2
    found = (config.known * usual + float(share @ shape)) / (config.known + float(share.sum()))
    found = min(max(found, usual), usual * WIDEST**2)
    together = 3 * config.common**2
    return usual / found, (usual + together) / (found + together)
