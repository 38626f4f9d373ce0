"""Say for every object what holds it, how hard each term pulls, and how well its place is known.

One look at the energy around the result (`explain_curvature`, `explain_spread`) and one light pass
over the bodies, for the few pixels and points in which an object feels them (`explain_bounds`,
`explain_space`, `explain_touch`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..explanation_records import Alternative, Bound, Facts, Passing, Pull, Touching
from ..geometry.placement import FREE, GROUND, place_in
from ..geometry.raster import Depths, Topology, look
from ..minimize import Observer, Step, silent
from ..records import record
from ..terms.bbox import SEEN
from ..types import Bodies, Layout, Objects
from .explain_bounds import bounds_of_objects
from .explain_curvature import Bend, bend_at, vector
from .explain_others import others_of
from .explain_space import passing_by
from .explain_spread import UNKNOWN, by_tilt, heat_of, measured, moves_without
from .explain_touch import touching_of
from .place_objects import PlaceConfig, Placed, PlaceInputs, energy_of, with_trees

SIDES = ("left", "upper", "right", "lower")


@dataclass(frozen=True)
class ExplainConfig:
    """Whether placements are explained."""

    use: bool = True
    """Ask of each object what holds it and how well its place is known."""


@record
class ExplainInputs:
    """The last descent, as it was priced, and who gave the evidence."""

    priced: PlaceInputs
    config: PlaceConfig
    placed: Placed
    bodies: Bodies | None
    """The bodies whose frames were gathered, in the world; None: the image alone."""
    pairs: Int[Tensor, "pairs 3"] | None
    """Body, object and part of every touch."""
    tilt: Float[Tensor, "3 3"] | None
    """Covariance of the camera's pitch and roll [rad] and of the floor [m]."""


@record
class Explained:
    """The facts of every object, in their order."""

    facts: tuple[Facts, ...]


@record
class _Evidence:
    """What can be said in words, by object."""

    bounds: tuple[tuple[Bound, ...], ...]
    passing: tuple[Passing | None, ...]
    touches: tuple[tuple[Touching, ...], ...]
    overlap: tuple[float | None, ...]


@record
class _Shape:
    """The energy around the result."""

    bend: Bend
    free: Bool[Tensor, "objects 7"]
    covariance: Float[Tensor, "objects 7 7"]
    tilt: Float[Tensor, "objects 7 7"]
    others: tuple[tuple[Alternative, ...], ...]


def explain_placements(
    inputs: ExplainInputs, config: ExplainConfig, observe: Observer = silent
) -> Explained:
    """Everything that is known of why the objects stand where they stand."""
    if not config.use or not inputs.priced.objects.ids:
        return Explained(())
    priced, placed = with_trees(inputs.priced), inputs.placed
    energy, free = energy_of(priced, inputs.config), _free(inputs)
    observe(Step("explain_placements", 0, 2))
    bend = bend_at(energy, placed.layout)
    heat = heat_of(bend.value.sum(0))
    covariance = measured(energy, placed.layout, bend.curve.sum(0), heat, free)
    others = others_of(placed, priced.reference, inputs.config.tie, energy)
    shape = _Shape(bend, free, covariance, _tilted(inputs, free), others)
    observe(Step("explain_placements", 1, 2))
    found = _evidence(inputs)
    count = len(priced.objects.ids)
    return Explained(tuple(_facts(inputs, i, shape, found) for i in range(count)))


def _free(inputs: ExplainInputs) -> Bool[Tensor, "objects 7"]:
    """What the evidence decides: no height of what stands, nothing of what is pinned."""
    objects, pinned = inputs.priced.objects, inputs.priced.pinned
    free = torch.ones(len(objects.ids), 7, dtype=torch.bool)
    free[:, 1] = objects.supports == FREE
    return free if pinned is None else free & ~pinned.fixed[:, None]


def _tilted(inputs: ExplainInputs, free: Tensor) -> Float[Tensor, "objects 7 7"]:
    """What the camera's and the floor's doubt does to objects that stand."""
    layout, priced = inputs.placed.layout, inputs.priced
    tilt = torch.zeros(3, 3) if inputs.tilt is None else inputs.tilt
    standing = (priced.objects.supports != FREE) & free[:, 0]
    return by_tilt(layout, priced.camera, priced.ground, tilt) * standing[:, None, None]


def _evidence(inputs: ExplainInputs) -> _Evidence:
    priced, layout, bodies = inputs.priced, inputs.placed.layout, inputs.bodies
    objects, image, humans = priced.objects, priced.image, priced.humans
    verts = place_in(objects.verts, layout, priced.camera.R_cam_world)
    shape = Topology(objects.faces, objects.edges)
    with torch.no_grad():
        drawn, seen = look(verts, shape, image.views, depth=humans.depth is not None)
    nothing = tuple(() for _ in objects.ids)
    bounds, touches = nothing, nothing
    passing: tuple[Passing | None, ...] = tuple(None for _ in objects.ids)
    if bodies is not None and humans.depth is not None and isinstance(seen, Depths):
        who = (bodies, priced.camera)
        bounds = bounds_of_objects(seen, image.masks, humans.depth, image.views, who)
    if bodies is not None and humans.space is not None:
        passing = passing_by(objects, layout, humans.space.volume, bodies)
    if bodies is not None and inputs.pairs is not None:
        touches = touching_of(objects, layout, humans.touches, inputs.pairs, bodies)
    return _Evidence(bounds, passing, touches, _overlaps(drawn, image.masks, image.keep))


def _overlaps(
    drawn: Float[Tensor, "objects h w"],
    masks: Float[Tensor, "objects h w"],
    keep: Bool[Tensor, "objects h w"],
) -> tuple[float | None, ...]:
    """IoU of silhouettes and masks in the pixels where it is known what would be seen."""
    ours, theirs = (drawn > 0.5) & keep, (masks > 0.5) & keep
    both = (ours & theirs).sum((-2, -1)) / (ours | theirs).sum((-2, -1)).clamp_min(1)
    known = theirs.any(-1).any(-1)
    return tuple(float(b) if k else None for b, k in zip(both, known.tolist(), strict=True))


def _facts(inputs: ExplainInputs, index: int, shape: _Shape, found: _Evidence) -> Facts:
    priced, pinned = inputs.priced, inputs.priced.pinned
    sides = priced.image.sides[index].tolist()
    return Facts(
        id=priced.objects.ids[index],
        energy=float(shape.bend.value[:, index].sum()),
        place=vector(inputs.placed.layout)[index].double(),
        covariance=shape.covariance[index],
        tilt=shape.tilt[index],
        pulls=_pulls(shape, index, inputs.placed.layout),
        alternatives=shape.others[index],
        bounds=found.bounds[index],
        passing=found.passing[index],
        touches=found.touches[index],
        overlap=found.overlap[index],
        hidden_sides=tuple(s for s, seen in zip(SIDES, sides, strict=True) if seen != SEEN),
        support=_support(priced.objects, index),
        pinned=pinned is not None and bool(pinned.fixed[index]),
    )


def _support(objects: Objects, index: int) -> str:
    below = int(objects.supports[index])
    return {GROUND: "ground", FREE: "free"}.get(below) or objects.ids[below]


def _pulls(shape: _Shape, index: int, layout: Layout) -> tuple[Pull, ...]:
    """Energy, force, absence and say in the distance of each term."""
    bend, free = shape.bend, shape.free[index]
    value, slope, curve = bend.value[:, index], bend.slope[:, index], bend.curve[:, index]
    heat, total = heat_of(value.sum()), value.abs().sum().clamp_min(1e-9)
    moves = moves_without(slope, curve, heat, free)
    tells = _tells(curve, heat, shape.covariance[index], layout.t_world_object[index])
    rows = zip(bend.terms, value, -slope * free, moves, tells, strict=True)
    return tuple(
        Pull(name, float(price), float(price / total), force, move, float(tell))
        for name, price, force, move, tell in rows
    )


def _tells(
    curve: Float[Tensor, "terms 7 7"],
    heat: Float[Tensor, ""],
    covariance: Float[Tensor, "7 7"],
    base: Float[Tensor, "3"],
) -> Float[Tensor, " terms"]:
    """Share of each term in the curvature along the ray, all other unknowns following.

    Sizes follow as the evidence wants them to: the direction is the regression of all unknowns on
    the distance. The rest of one is told by nothing but the general spread of such unknowns.
    """
    ray = torch.zeros(7, dtype=torch.float64)
    ray[[0, 2]] = base[[0, 2]].double() / base[[0, 2]].double().norm().clamp_min(1e-6)
    along = covariance @ ray
    variance = (along @ ray).clamp_min(1e-12)
    way = along / variance
    bent = torch.einsum("i,kij,j->k", way, curve, way).clamp_min(0) / heat
    sigma = torch.tensor(UNKNOWN, dtype=torch.float64)
    known = (way / sigma).square().sum()
    return bent / (bent.sum() + known).clamp_min(1e-12)
