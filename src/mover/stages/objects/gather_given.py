"""What is known of the furniture before it is seen: as given, of standard sizes, along axes."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import Heading, Layout, Objects
from mover.energy.human_terms import ContactPoints
from mover.energy.image_terms import LEAST, LIKELY, SEEN, UNKNOWN
from mover.energy.prior_terms import COMMON, SIZE, TURN, Given
from mover.furniture.library import STANDARD, WALL_PIECES, WIDE_CLASSES, canonical
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
    standard, precision = standard_sizes(objects)
    along = chance_along(objects.categories)
    known = torch.ones_like(start.yaw)
    weight = prior_weights(energy)
    found = (LOOSE * (0.1 + weight).sqrt()).clamp(SQUARE, TURN)
    said = [(start.yaw, TURN * known, along), (layout.yaw, found, along)]
    if heading is not None:
        yaw, off, sure = along.new_tensor([[heading.yaw], [heading.spread], [WALLS]])
        said.append((yaw, off, sure))
    axes = _own_axes(along, room_axis(said), edges)
    return Given(
        distance=start.t_world_object.norm(dim=-1), yaw=start.yaw, along=axes.along.to(known),
        sharpness=axes.sharpness.to(known), axis=axes.yaw.to(known),
        standard=standard, precision=precision, weight=weight,
    )  # fmt: skip


@record
class _Axes:
    """Along what each object runs."""

    along: Float[Tensor, " objects"]
    """The chance that it does."""
    yaw: Float[Tensor, " objects"]
    """Up to quarter turns [rad]."""
    sharpness: Float[Tensor, " objects"]
    """Of the density of yaws along it."""


def _own_axes(
    along: Float[Tensor, " objects"], room: tuple[float, float], edges: OwnEdges | None
) -> _Axes:
    """The room's axis, and of objects whose own edges agree their own."""
    one = torch.ones_like(along)
    axes = _Axes(along.clone(), room[0] * one, _sharpness(SQUARE, room[1]) * one)
    if edges is None:
        return axes
    near = math.hypot(SQUARE, room[1]) * one
    spread = torch.hypot(edges.spread, torch.full_like(edges.spread, STRAIGHT))
    level = torch.full_like(edges.yaw, LEVEL)
    for k in edges.of.unique():
        mine, own = k.view(1), edges.of == k
        beside = (axes.yaw[mine], near[mine], along[mine])
        yaw, off = room_axis([beside, (edges.yaw[own], spread[own], level[own])])
        if off < AGREED:
            axes.along[k], axes.yaw[k] = AGREES, yaw
            axes.sharpness[k] = _sharpness(STRAIGHT, off)
    return axes


def _sharpness(stands: float, off: float) -> float:
    """Of the density of yaws that stand so well along an axis which is so far off [rad]."""
    return 1 / (4 * math.hypot(stands, off)) ** 2


def chance_along(categories: Sequence[str]) -> Float[Tensor, " objects"]:
    """How probably each object stands along an axis of the room."""
    return torch.tensor([OFTEN if c in WALL_PIECES else SELDOM for c in categories])


def given_axis(categories: Sequence[str], heading: Heading, edges: OwnEdges | None = None) -> Given:
    """The same where nothing was given: of a room whose walls are seen, the axis alone."""
    axes = _own_axes(chance_along(categories), (heading.yaw, heading.spread), edges)
    known = unplaced(len(axes.yaw))
    return replace(known, along=axes.along, sharpness=axes.sharpness, axis=axes.yaw)


def unplaced(count: int) -> Given:
    """Nothing at all, of so many objects."""
    known, none = torch.ones(count), torch.zeros(count, 3)
    return Given(
        distance=known, yaw=0 * known, along=0 * known, sharpness=known, axis=0 * known,
        standard=none, precision=none, weight=known, placed=False,
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
    """The same, lighter for what people use: they say where it stands, whatever its outline.

    Args:
        given: What is known without the people.
        trust: Weight of each silhouette beside them.
        touches: What they touch.
    """
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


def standard_sizes(
    objects: Objects,
) -> tuple[Float[Tensor, "objects 3"], Float[Tensor, "objects 3"]]:
    """Logarithms of the standard sizes over those of the meshes, and how well they are known.

    Detectors call a coffee table a dining table. So of the classes that have one name the first
    counts whose standard the given size does not contradict, and none where all are contradicted.
    """
    known = [
        _standard_of(MEANINGS.get(category, (category,)), size)
        for category, size in zip(objects.categories, objects.size, strict=True)
    ]
    return _in_tables(known, objects.size)


def _standard_of(
    names: Sequence[str], size: Float[Tensor, "3"]
) -> list[tuple[int, Float[Tensor, ""], float]]:
    """Axis, logarithm over the given size and its spread, of the first class that fits the size."""
    for name in names:
        known = _off_standard(name, size)
        if all(abs(x) < CONTRADICTED * math.hypot(s, SIZE, COMMON) for _, x, s in known):
            return known
    return []


def _off_standard(
    name: str, size: Float[Tensor, "3"]
) -> list[tuple[int, Float[Tensor, ""], float]]:
    return [
        (axis, math.log(usual[0]) - size[axis].log(), usual[1])
        for axis, usual in enumerate(STANDARD.get(name, ()))
        if usual is not None
    ]


def sizes_of_shapes(
    categories: Sequence[str], sizes: Float[Tensor, "items 3"]
) -> tuple[Float[Tensor, "items 3"], Float[Tensor, "items 3"]]:
    """The same of shapes that may stand for things of a class: firm standards only.

    Of a class with several meanings (a dining table of COCO may be a desk or a coffee table) it is
    that which the size of the shape fits; of what is not firm the shape itself says as much.
    """
    known = [
        _standard_of(MEANINGS[category], size)
        if category in MEANINGS
        else _off_standard(category, size)
        for category, size in zip(categories, sizes, strict=True)
    ]
    known = [[row for row in rows if row[2] <= FIRM] for rows in known]
    return _in_tables(known, sizes)


def _in_tables(
    known: Sequence[list[tuple[int, Float[Tensor, ""], float]]], like: Float[Tensor, "items 3"]
) -> tuple[Float[Tensor, "items 3"], Float[Tensor, "items 3"]]:
    usual, sharp = torch.zeros_like(like), torch.zeros_like(like)
    for i, row in enumerate(known):
        for axis, off, sigma in row:
            usual[i, axis], sharp[i, axis] = off, 1 / sigma**2
    return usual, sharp


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
