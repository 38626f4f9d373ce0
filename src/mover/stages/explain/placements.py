"""Say for every object what holds it, how hard each term pulls, and how well its place is known.

One look at the energy around the result (`spread`) and one light pass over the bodies, for the
few pixels and points in which an object feels them (`evidence`).
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.explanation import Alternative, Facts, Pull
from mover.core.observe import Energy, Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies, Layout
from mover.energy.terms.bbox import SEEN
from mover.geometry.placement import FREE, place_in
from mover.geometry.raster import Depths, Topology, look
from mover.geometry.rotations import wrap
from mover.stages.config import ExplainConfig, PlaceConfig
from mover.stages.explain.evidence import bounds_of_objects, passing_by, touching_of
from mover.stages.explain.spread import (
    UNKNOWN,
    Bend,
    bend_at,
    by_tilt,
    by_whole,
    heat_of,
    measured,
    moves_without,
    unvector,
    vector,
)
from mover.stages.objects.place_inputs import Placed, PlaceInputs
from mover.stages.objects.place_objects import energy_of, with_trees
from mover.stages.objects.prepare_objects import support_names
from mover.stages.objects.starts import MOVED, TURNED

# Other places that the evidence allows nearly as well as the chosen one.

HIGHEST = 6.0  # rise from which on an alternative is not told


def others_of(
    placed: Placed,
    reference: Float[Tensor, " objects"],
    yaw_prior_weight: float,
    energy: Callable[[Layout], Energy],
) -> tuple[tuple[Alternative, ...], ...]:
    """For each object its candidates that really differ from the result and from each other.

    The candidates of the descents, and the result turned round: tables and cabinets look alike
    from behind. They rank as in `starts.choose`.
    """
    base = vector(placed.layout)
    behind = turned_round(base)
    with torch.no_grad():
        whole = energy(unvector(torch.stack([base, behind]))).per_item
    rows = torch.cat([base[None], vector(placed.candidates), behind[None]])
    value = torch.cat([whole[:1], placed.energy.to(whole), whole[1:]]).double()
    turn = 1 - (rows[..., 3] - reference).cos().double()
    rank = (value + 0.01) * (1 + yaw_prior_weight * turn / 2)
    rise = (rank - rank[0]) / heat_of(value[0])
    return tuple(_apart(rows[:, i].double(), rise[:, i]) for i in range(rows.shape[1]))


def _apart(
    rows: Float[Tensor, "places 7"], rise: Float[Tensor, " places"]
) -> tuple[Alternative, ...]:
    """Places other than the first one, lowest first, that differ from all before."""
    kept: list[int] = [0]
    for k in (1 + rise[1:].argsort(stable=True)).tolist():
        if float(rise[k]) < HIGHEST and all(_differ(rows[k], rows[j]) for j in kept):
            kept.append(k)
    return tuple(Alternative(float(rise[k]), rows[k]) for k in kept[1:])


def turned_round(rows: Float[Tensor, "*any 7"]) -> Float[Tensor, "*any 7"]:
    """Objects whose front is where their back was."""
    yaw = wrap(rows[..., 3:4] + torch.pi)
    return torch.cat([rows[..., :3], yaw, rows[..., 4:]], -1)


def _differ(a: Float[Tensor, "7"], b: Float[Tensor, "7"]) -> bool:
    return float(wrap(a[3] - b[3]).abs()) >= TURNED or float((a[:3] - b[:3]).norm()) >= MOVED


SIDES = ("left", "upper", "right", "lower")


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
    scale: float = 0.0
    """Standard deviation of the logarithm of the room's scale; 0: it is known."""
    focal: float = 0.0
    """The same of the focal length."""


@record
class Explained:
    """The facts of every object, in their order."""

    facts: tuple[Facts, ...]


def explain_placements(
    inputs: ExplainInputs, config: ExplainConfig, observe: Observer = silent
) -> Explained:
    """Everything that is known of why the objects stand where they stand."""
    if not config.use or not inputs.priced.objects.ids:
        return Explained(())
    priced, placed = with_trees(inputs.priced), inputs.placed
    objects, pinned = priced.objects, priced.pinned
    energy, free = energy_of(priced, inputs.config), _free(inputs)
    observe(Step("explain_placements", 0, 2))
    bend = bend_at(energy, placed.layout)
    value = bend.value.sum(0)
    covariance = measured(energy, placed.layout, bend.curve.sum(0), heat_of(value), free)
    weight = inputs.config.yaw_prior_weight
    facts = {
        "id": objects.ids,
        "energy": value.tolist(),
        "place": vector(placed.layout).double(),
        "covariance": covariance,
        "tilt": _tilted(inputs, free),
        "whole": _whole(inputs, free),
        "pulls": _pulls(bend, free, covariance, placed.layout),
        "alternatives": others_of(placed, priced.reference, weight, energy),
        "support": list(support_names(objects)),
        "pinned": [False] * len(value) if pinned is None else pinned.fixed.tolist(),
    }
    observe(Step("explain_placements", 1, 2))
    facts |= _evidence(inputs)
    rows = zip(*facts.values(), strict=True)
    return Explained(tuple(Facts(**dict(zip(facts, row, strict=True))) for row in rows))


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


def _whole(inputs: ExplainInputs, free: Tensor) -> Float[Tensor, "objects 7 7"]:
    """What the doubt about scale and lens does to all that is not pinned."""
    camera, layout = inputs.priced.camera, inputs.placed.layout
    return by_whole(layout, camera, inputs.scale, inputs.focal) * free[:, 0, None, None]


def _evidence(inputs: ExplainInputs) -> dict[str, Sequence[Any]]:
    """What can be said in words, by object."""
    priced, layout, bodies = inputs.priced, inputs.placed.layout, inputs.bodies
    objects, image, humans = priced.objects, priced.image, priced.humans
    verts = place_in(objects.verts, layout, priced.camera.R_cam_world)
    shape = Topology(objects.faces, objects.edges)
    with torch.no_grad():
        drawn, seen = look(verts, shape, image.views, depth=humans.depth is not None)
    nothing = [()] * len(objects.ids)
    found: dict[str, Sequence[Any]] = {
        "bounds": nothing,
        "passing": [None] * len(objects.ids),
        "touches": nothing,
        "overlap": _overlaps(drawn, image.masks, image.keep),
        "hidden_sides": [
            tuple(name for name, side in zip(SIDES, sides, strict=True) if side != SEEN)
            for sides in image.sides.tolist()
        ],
    }
    if bodies is not None and humans.depth is not None and isinstance(seen, Depths):
        who = (bodies, priced.camera)
        found["bounds"] = bounds_of_objects(seen, image.masks, humans.depth, image.views, who)
    if bodies is not None and humans.space is not None:
        found["passing"] = passing_by(objects, layout, humans.space.volume, bodies)
    if bodies is not None and inputs.pairs is not None:
        found["touches"] = touching_of(objects, layout, humans.touches, inputs.pairs, bodies)
    return found


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


def _pulls(
    bend: Bend,
    free: Bool[Tensor, "objects 7"],
    covariance: Float[Tensor, "objects 7 7"],
    layout: Layout,
) -> list[tuple[Pull, ...]]:
    """Energy, force, absence and say in the distance of each term, by object."""
    found: list[tuple[Pull, ...]] = []
    for i in range(len(free)):
        value, slope, curve = bend.value[:, i], bend.slope[:, i], bend.curve[:, i]
        heat, total = heat_of(value.sum()), value.abs().sum().clamp_min(1e-9)
        moves = moves_without(slope, curve, heat, free[i])
        constrains = _constrains(curve, heat, covariance[i], layout.t_world_object[i])
        rows = zip(bend.terms, value, -slope * free[i], moves, constrains, strict=True)
        found.append(tuple(
            Pull(name, float(energy), float(energy / total), force, move, float(share))
            for name, energy, force, move, share in rows
        ))  # fmt: skip
    return found


def _constrains(
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
