"""Move the objects until the image and the people agree (Sec. 3.2, "Optimization")."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mover.core.observe import Energy, Observer, silent
from mover.core.types import Layout
from mover.energy.bfgs import Problems, minimize_batched
from mover.energy.config import Adam, BatchedBFGS, SceneConfig
from mover.energy.fused.energy import EnergyOf, energy_of_rows
from mover.energy.minimize import Minimum, minimize
from mover.energy.objective import Rows, of_objects, some_supports
from mover.geometry.placement import rest_on_support
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_inputs import (
    Placed,
    PlaceInputs,
    coarser_humans,
    coarser_image,
    hold,
    with_walls,
)
from mover.stages.objects.separate_objects import separate_objects
from mover.stages.objects.starts import best_few, choose, duplicates_of, piles_of, spread
from mover.stages.objects.wall_alignment import line_up


def place_objects(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Placed:
    """Minimise Eq. 1 over the layout, from one start or from many."""

    def lower(given: PlaceInputs, starts: Layout) -> Placed:
        found = descend(given, config, starts, config.method, observe)
        energy, order = found.value.sort(dim=0, stable=True)
        candidates = found.at.gather(order)
        at = choose(candidates, energy, given.reference, config.yaw_prior_weight)
        return Placed(at, candidates, energy, found.trace, given.image.walls)

    placed = lower(inputs, starts_left(inputs, config, observe))
    if config.walls:
        placed = line_up(placed, inputs, lower)
    if not config.apart:
        return placed
    energy = energy_of(with_walls(inputs, placed.walls), config)
    at = separate_objects(energy, inputs.objects, placed.layout, config.apart, observe)
    return replace(placed, layout=standing(inputs, at))


def starts_left(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Layout:
    """The starts of the main descents: turned round, and thinned out by short descents."""
    starts = spread(inputs.starts, config.yaws) if config.yaws > 1 else inputs.starts
    if not config.short.steps:
        return starts
    blurred = replace(
        inputs,
        image=coarser_image(inputs.image, config.coarse),
        humans=coarser_humans(inputs.humans, config.coarse),
    )
    found = descend(blurred, config, starts, config.short, observe)
    return best_few(found.at, found.value, config.num_hypotheses)


def energy_of(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Layout], Energy]:
    """The energy as a function of layouts whose heights are still to be eliminated."""
    energy = _rows(inputs, config)(None)
    return lambda layout: energy(standing(inputs, layout))


def _rows(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Rows | None], EnergyOf]:
    growth = config.uniform_scale_weight
    weights = SceneConfig(config.weights, config.form, growth, config.readings)
    return energy_of_rows(inputs.objects, inputs.camera, inputs.image, inputs.humans, weights)


def standing(inputs: PlaceInputs, layout: Layout) -> Layout:
    """The layout with what is pinned at its position, and the rest on its supports."""
    objects, held = inputs.objects, hold(layout, inputs.pinned)
    return rest_on_support(held, objects.supports, objects.size[:, 1], inputs.ground)


def descend(
    inputs: PlaceInputs,
    config: PlaceConfig,
    starts: Layout,
    method: Adam | BatchedBFGS,
    observe: Observer,
) -> Minimum[Layout]:
    """Follow the energy from each start; the result stands on its supports."""
    if isinstance(method, BatchedBFGS):
        problems = _problems(inputs, config, starts)
        found = minimize_batched(problems, method, observe, "place_objects")
    else:
        energy = energy_of(inputs, config)
        found = minimize(energy, starts, method, observe, "place_objects")
    return Minimum(standing(inputs, found.at), found.value, found.trace)


def _problems(inputs: PlaceInputs, config: PlaceConfig, starts: Layout) -> Problems[Layout]:
    """Each start of each object as a problem of its own; loads belong to their carriers."""
    (count, n), objects, some_energy = starts.yaw.shape, inputs.objects, _rows(inputs, config)

    def of(rows: Tensor) -> Callable[[Layout], Energy]:
        index, energy = rows % n, some_energy(rows)
        supports, heights = some_supports(objects.supports, rows), objects.size[index, 1]
        pinned = inputs.pinned and of_objects(inputs.pinned, index, n)

        def some(free: Layout) -> Energy:
            held = hold(free, pinned)
            return energy(rest_on_support(held, supports, heights, inputs.ground))

        return some

    pile = piles_of(objects.supports)
    like = (duplicates_of(starts, pile) * n + torch.arange(n).to(pile)).flatten()
    if not bool((objects.supports >= 0).any()):
        return Problems(of, starts, (count, n), None, like)
    group = pile + n * torch.arange(count).to(pile)[:, None]
    return Problems(of, starts, (count, n), group.flatten(), like)
