"""Move the objects until the image and the people agree (Sec. 3.2, "Optimization")."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..energy import HumanCues, ImageCues, SceneConfig, SceneWeights
from ..energy_warp import never_asks, pricing, pricing_rows
from ..geometry.placement import stand
from ..minimize import Adam, Energy, Minimum, Observer, Step, minimize, silent
from ..minimize_newton import Problems, Quasi, settle
from ..records import to_device
from ..terms import Form
from ..terms.contact_reach import together
from ..terms.contact_trees import trees_of
from ..types import Camera, Layout, Objects
from .coarser import coarser_humans, coarser_image
from .line_up import line_up
from .part_objects import part_objects
from .pinned import hold
from .place_inputs import Moment as Moment
from .place_inputs import PlaceConfig as PlaceConfig
from .place_inputs import Placed as Placed
from .place_inputs import PlaceInputs as PlaceInputs
from .place_inputs import with_walls
from .some_objects import some_humans, some_image, some_objects, some_pinned
from .spans import bounded, spans_of, unbounded
from .starts import best_few, choose, joined, shaken, spread, spread_distance


def place_objects(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Placed:
    """Minimise Eq. 1 over the layout, from one start or from many."""
    inputs = with_trees(inputs, config.form)
    found = descend(inputs, config, starts_left(inputs, config, observe), config.method, observe)
    for number in range(config.rounds if config.shaken else 0):
        around = shaken(best_few(found.at, found.value, 1), config.shaken, number)
        more = descend(inputs, config, around, config.method, observe)
        found = Minimum(
            joined(found.at, more.at),
            torch.cat([found.value, more.value]),
            torch.cat([found.trace, more.trace]),
        )

    def lower(given: PlaceInputs, starts: Layout) -> Placed:
        return _best_first(descend(given, config, starts, config.method, observe), given, config)

    placed = line_up(_best_first(found, inputs, config), inputs, config.lined, lower)
    if not config.apart:
        return placed
    energies = energy_of(with_walls(inputs, placed.walls), config)
    at = part_objects(energies, inputs.objects, placed.layout, config.apart, observe)
    return replace(placed, layout=_standing(inputs, at))


def _best_first(found: Minimum[Layout], inputs: PlaceInputs, config: PlaceConfig) -> Placed:
    """The ends of descents, and the one of each object that is chosen."""
    candidates = best_few(found.at, found.value, len(found.value), apart=False)
    energy = found.value.sort(0).values
    at = choose(candidates, energy, inputs.reference, config.tie)
    return Placed(at, candidates, energy, found.trace, inputs.image.walls)


def starts_left(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Layout:
    """The starts of the main descents: spread, and thinned out by short descents."""
    starts = inputs.starts
    if config.first.steps:
        starts = _by_boxes(inputs, config, starts, observe)
    starts = spread_distance(starts, config.distances)
    if config.yaws > 1:
        starts = spread(starts, config.yaws)
    if not config.short.steps:
        return starts
    blurred = replace(
        inputs,
        image=coarser_image(inputs.image, config.coarse),
        humans=coarser_humans(inputs.humans, config.coarse),
    )
    found = descend(blurred, config, starts, config.short, observe)
    return best_few(found.at, found.value, config.keep)


def energy_of(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Layout], Energy]:
    """The energy as a function of layouts whose heights are still to be eliminated."""
    price = pricing(*_evidence(inputs), priced(config))
    return lambda layout: price(_standing(inputs, layout))


def priced(config: PlaceConfig) -> SceneConfig:
    """How the stage prices the room."""
    return SceneConfig(config.weights, config.form, config.growth)


def _evidence(inputs: PlaceInputs) -> tuple[Objects, Camera, ImageCues, HumanCues]:
    return inputs.objects, inputs.camera, inputs.image, inputs.humans


def _standing(inputs: PlaceInputs, layout: Layout) -> Layout:
    """The layout with what is pinned at its place, and the rest on its supports."""
    objects, held = inputs.objects, hold(layout, inputs.pinned)
    return stand(held, objects.supports, objects.size[:, 1], inputs.ground)


def descend(
    inputs: PlaceInputs,
    config: PlaceConfig,
    starts: Layout,
    method: Adam | Quasi,
    observe: Observer,
) -> Minimum[Layout]:
    """Follow the energy from each start; the result stands on its supports."""
    span = spans_of(inputs.objects, config.span, config.chair_span)

    def at(free: Layout) -> Layout:
        return _standing(inputs, bounded(free, span))

    def watched(step: Step) -> None:
        free = step.at
        assert free is not None
        observe(replace(step, at=lambda: moment(at(free()))))

    def moment(layout: Layout) -> Moment:
        return to_device(Moment(layout, inputs.camera, inputs.ground), "cpu")

    begin = unbounded(starts, span)
    if isinstance(method, Quasi):
        found = settle(_problems(inputs, config, begin), method, watched, "place_objects")
    else:
        energy = _free_energy(inputs, config)
        still = never_asks(inputs.objects)
        found = minimize(energy, begin, method, watched, "place_objects", still=still)
    return Minimum(at(found.at), found.value, found.trace)


def with_trees(inputs: PlaceInputs, form: Form = "robust") -> PlaceInputs:
    """The inputs with search trees of what is touched, where these help."""
    humans = inputs.humans
    if humans.touches is None:
        return inputs
    touches = together(humans.touches) if form != "robust" else humans.touches
    trees = trees_of(inputs.objects, touches, form)
    return replace(inputs, humans=replace(humans, touches=touches, trees=trees))


def _free_energy(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Layout], Energy]:
    """The energy as a function of the unknowns of a descent."""
    span = spans_of(inputs.objects, config.span, config.chair_span)
    energy = energy_of(inputs, config)
    return (lambda free: energy(bounded(free, span))) if bool(span.any()) else energy


def _problems(inputs: PlaceInputs, config: PlaceConfig, begin: Layout) -> Problems[Layout]:
    """Each start of each object as a problem of its own; loads belong to their carriers."""
    starts, n = begin.yaw.shape
    price = pricing_rows(*_evidence(inputs), priced(config))
    span = spans_of(inputs.objects, config.span, config.chair_span)

    def of(rows: Tensor) -> Callable[[Layout], Energy]:
        index = rows % n
        few = replace(
            inputs,
            objects=some_objects(inputs.objects, rows),
            reference=inputs.reference[index],
            pinned=some_pinned(inputs.pinned, index),
        )
        if (known := price) is not None:
            return lambda free: known(_standing(few, bounded(free, span[index])), rows)
        image, humans = some_image(inputs.image, index), some_humans(inputs.humans, index, n)
        return _free_energy(replace(few, image=image, humans=humans), config)

    carrier = inputs.objects.supports
    if not bool((carrier >= 0).any()):
        return Problems(of, begin, (starts, n))
    root = torch.where(carrier >= 0, carrier, torch.arange(n).to(carrier))
    for _ in range(n):
        root = root[root]
    group = root + n * torch.arange(starts).to(root)[:, None]
    return Problems(of, begin, (starts, n), group.flatten())


def _by_boxes(
    inputs: PlaceInputs, config: PlaceConfig, starts: Layout, observe: Observer
) -> Layout:
    """Release: the places alone, by the box term alone."""
    energy = energy_of(inputs, replace(config, weights=SceneWeights(600.0, *[0.0] * 10)))

    def at(free: Layout) -> Layout:
        return replace(starts, t_world_object=free.t_world_object)

    found = minimize(
        lambda free: energy(at(free)), starts, config.first, observe, "place_objects",
        still=never_asks(inputs.objects),
    )  # fmt: skip
    return at(found.at)
