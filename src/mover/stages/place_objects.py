"""Move the objects until the image and the people agree (Sec. 3.2, "Optimization")."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from ..energy import HumanCues, ImageCues, SceneConfig, SceneWeights, scene_energy
from ..geometry.placement import stand
from ..minimize import Adam, Energy, Minimum, Observer, Step, minimize, silent
from ..records import record
from ..terms import Form
from ..types import Camera, Layout, Objects
from .pinned import Pinned, hold
from .starts import best_few, choose, spread


@dataclass(frozen=True)
class PlaceConfig:
    """How the objects are placed."""

    weights: SceneWeights = field(default_factory=SceneWeights)
    form: Form = "paper"
    """How the terms are priced."""
    method: Adam = field(default_factory=Adam)
    """The descent from each start that is left."""
    first: Adam = field(default_factory=lambda: Adam(steps=0))
    """A descent of the box term over the places alone, before all others (release)."""
    yaws: int = 1
    """Starts that are turned evenly round each object."""
    short: Adam = field(default_factory=lambda: Adam(steps=0))
    """A short descent from each of them."""
    keep: int = 1
    """Starts of each object that are left after the short descents."""
    tie: float = 0.0
    """How much a turn away from the reference yaw worsens a candidate: 1 doubles half a turn."""
    span: float = 0.0
    """Release: scales stay within 1 +- span/2 by a sigmoid; 0: free."""
    chair_span: float = 0.0
    """The same for chairs."""


@record
class PlaceInputs:
    """What placing the objects needs."""

    objects: Objects
    camera: Camera
    ground: float
    image: ImageCues
    humans: HumanCues
    starts: Layout
    """Candidates on a leading axis."""
    reference: Float[Tensor, " objects"]
    """Yaw that breaks ties: of the sitters where there are any, else the initial one [rad]."""
    pinned: Pinned | None = None
    """Objects that stay where they are; None: all may move."""


@record
class Moment:
    """The room in the middle of a descent, for those who watch."""

    layout: Layout
    """All starts."""
    camera: Camera
    ground: float


@record
class Placed:
    """Where the objects ended."""

    layout: Layout
    """The chosen candidate of each object."""
    candidates: Layout
    """All that were left, best first."""
    energy: Float[Tensor, "starts objects"]
    """Of the candidates."""
    trace: Float[Tensor, " steps"]
    """Total energy before each step of the last descent, summed over the candidates."""


def place_objects(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Placed:
    """Minimise Eq. 1 over the layout, from one start or from many."""
    starts = inputs.starts
    if config.first.steps:
        starts = _by_boxes(inputs, config, starts, observe)
    if config.yaws > 1:
        starts = spread(starts, config.yaws)
    if config.short.steps:
        found = descend(inputs, config, starts, config.short, observe)
        starts = best_few(found.at, found.value, config.keep)
    found = descend(inputs, config, starts, config.method, observe)
    candidates = best_few(found.at, found.value, len(found.value), apart=False)
    energy = found.value.sort(0).values
    at = choose(candidates, energy, inputs.reference, config.tie)
    return Placed(at, candidates, energy, found.trace)


def energy_of(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Layout], Energy]:
    """The energy as a function of layouts whose heights are still to be eliminated."""
    scene = SceneConfig(config.weights, config.form)
    objects = inputs.objects
    heights = objects.size[:, 1]

    def energy(layout: Layout) -> Energy:
        held = hold(layout, inputs.pinned)
        standing = stand(held, objects.supports, heights, inputs.ground)
        return scene_energy(standing, objects, inputs.camera, inputs.image, inputs.humans, scene)

    return energy


def descend(
    inputs: PlaceInputs, config: PlaceConfig, starts: Layout, method: Adam, observe: Observer
) -> Minimum[Layout]:
    """Follow the energy from each start; the result stands on its supports."""
    energy, objects = energy_of(inputs, config), inputs.objects
    span = torch.tensor(
        [config.chair_span if c == "chair" else config.span for c in objects.categories]
    )

    def at(free: Layout) -> Layout:
        held = hold(_bounded(free, span), inputs.pinned)
        return stand(held, objects.supports, objects.size[:, 1], inputs.ground)

    def watched(step: Step) -> None:
        free = step.at
        assert free is not None
        observe(replace(step, at=lambda: Moment(at(free()), inputs.camera, inputs.ground)))

    found = minimize(
        lambda free: energy(_bounded(free, span)),
        _unbounded(starts, span),
        method,
        watched,
        "place_objects",
    )
    return Minimum(at(found.at), found.value, found.trace)


def _by_boxes(
    inputs: PlaceInputs, config: PlaceConfig, starts: Layout, observe: Observer
) -> Layout:
    """Release: the places alone, by the box term alone."""
    energy = energy_of(inputs, replace(config, weights=_only(bbox=600.0)))

    def at(free: Layout) -> Layout:
        return replace(starts, t_world_object=free.t_world_object)

    found = minimize(lambda free: energy(at(free)), starts, config.first, observe, "place_objects")
    return at(found.at)


def _only(**weights: float) -> SceneWeights:
    zeros = dict.fromkeys(SceneWeights.__dataclass_fields__, 0.0)
    return SceneWeights(**(zeros | weights))


def _bounded(free: Layout, span: Float[Tensor, " objects"]) -> Layout:
    """Scales s = 1 + span (sigmoid(x) - 1/2), where there is a span."""
    wide = span.unsqueeze(-1)
    scale = 1 + wide * (free.log_scale.sigmoid() - 0.5)
    return replace(free, log_scale=torch.where(wide > 0, scale.log(), free.log_scale))


def _unbounded(layout: Layout, span: Float[Tensor, " objects"]) -> Layout:
    """The inverse of `_bounded` (the release codes it without its denominator, by mistake)."""
    wide = span.unsqueeze(-1)
    share = (layout.log_scale.exp() - 1) / wide.clamp_min(1e-6) + 0.5
    return replace(
        layout, log_scale=torch.where(wide > 0, share.clamp(0.01, 0.99).logit(), layout.log_scale)
    )
