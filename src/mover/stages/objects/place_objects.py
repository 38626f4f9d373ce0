"""Move the objects until the image and the people agree (Sec. 3.2, "Optimization")."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Energy, Observer, Step, silent
from mover.core.records import to_device
from mover.core.types import Camera, Layout, Objects
from mover.energy.config import Adam, BatchedBFGS, SceneConfig
from mover.energy.fused.energy import energy_function, energy_of_rows, never_asks
from mover.energy.human_terms import trees_of
from mover.energy.minimize import Minimum, minimize
from mover.energy.newton import Problems, settle
from mover.energy.objective import (
    HumanCues,
    ImageCues,
    of_objects,
    some_objects,
    some_supports,
)
from mover.energy.prior_terms import apart_term, gather_solids
from mover.geometry.boxes import Box, corners
from mover.geometry.placement import rest_on_support
from mover.geometry.sections import Sections, sections_of
from mover.stages.config import PlaceConfig as PlaceConfig
from mover.stages.config import SpreadConfig
from mover.stages.objects.place_inputs import Moment as Moment
from mover.stages.objects.place_inputs import Placed as Placed
from mover.stages.objects.place_inputs import PlaceInputs as PlaceInputs
from mover.stages.objects.place_inputs import coarser_humans, coarser_image, hold, with_walls
from mover.stages.objects.starts import (
    alike,
    alone,
    best_few,
    choose,
    joined,
    merged,
    piles_of,
    shaken,
    spread,
    spread_distance,
)
from mover.stages.objects.wall_alignment import line_up

# How far the given sizes of a room's furniture are off, as its image tells (not in the paper).
#
# The price of sizes (`prior_terms`) suits tools whose sizes err as much as usual. Where the image
# alone changes the shapes of a room's furniture more than that, the sizes that it cannot tell (the
# depth of a cabinet that is seen from the front) are worth less too. Logarithms of the three sizes
# of a piece are c + e_k, with c common (a piece that was placed too far was made too large) and e_k
# independent; then the price of a normal distribution is
#
#     \sum_k (l_k - m)^2 / v + 3 m^2 / (v + 3 w),   m = mean l_k,  v = var e_k,  w = var c,
#
# of which v is learnt from the room (empirical Bayes) and w is not. A piece whose silhouette cannot
# be made to fit (another shape, a bad mask) changes its sizes whether they are wrong or not, so it
# counts by the square of what its silhouette is believed.

FIT = 0.1  # image energy (robust form) from which on an object's shape is believed less
LEAST = 0.1  # of what a silhouette that fits is believed


def inlier_weights(energy: Float[Tensor, " objects"]) -> Float[Tensor, " objects"]:
    """How far the shapes of objects are believed: 1 where the image can be made to fit.

    Args:
        energy: What is left of the image's energy (robust form) where each object fits best.
    """
    return (FIT / energy.clamp_min(1e-6)).clamp(LEAST, 1)


def estimate_size_prior(
    layout: Layout, trust: Float[Tensor, " objects"], config: SpreadConfig
) -> tuple[float, float]:
    """Factors on the price of another shape, and on that of another size as a whole.

    Args:
        layout: Where and how large the image alone has the objects, of one start.
        trust: How far the shape of each is believed, see `inlier_weights`.
        config: What is usual.
    """
    if config.usual <= 0:
        return 1.0, 1.0
    log_scale, usual, share = layout.log_scale, config.usual**2, trust.square()
    shape = (log_scale - log_scale.mean(-1, keepdim=True)).square().sum(-1) / 2
    found = (config.known * usual + float(share @ shape)) / (config.known + float(share.sum()))
    found = min(max(found, usual), usual * config.most**2)
    together = 3 * config.common**2
    return usual / found, (usual + together) / (found + together)


# Part objects that stand in each other, by a last descent of all of them together.
#
# Each object alone is placed by what is seen of it. A nightstand behind a bed may then stand partly
# in the bed at no price; together, both go where neither image nor people mind.


NEAR = 0.1  # [m], boxes whose circles are no nearer are not looked at
METHOD = Adam(200, 0.01, 0.001, beta2=0.98)  # 80 cm at most


def part_objects(
    energy: Callable[[Layout], Energy],
    objects: Objects,
    layout: Layout,
    weight: float,
    observe: Observer = silent,
) -> Layout:
    """Minimise the energy of all objects and what they share of space.

    Args:
        energy: Of layouts with one start.
        objects: The objects.
        layout: Where they were found alone.
        weight: Of what they share.
        observe: Told of every step.

    Returns:
        The same layout if none stands in another; in any case the same place of each object that
        has no part in it.
    """
    if weight == 0:
        return layout
    shared = sharing(objects, layout)
    with torch.no_grad():
        if not bool((shared(layout) > 0).any()):
            return layout

    def together(free: Layout) -> Energy:
        return Energy({"alone": energy(alone(free)).per_item[0], "apart": weight * shared(free)})

    still = never_asks(objects)
    found = minimize(together, layout, METHOD, observe, "place_objects", still=still).at
    concerned = _pushed(shared, layout) | _pushed(shared, found)
    return merged(concerned, found, layout)


def _pushed(shared: Callable[[Layout], Tensor], layout: Layout) -> Bool[Tensor, " objects"]:
    """The objects that stand in another, and those in which another stands."""
    t = layout.t_world_object.detach().clone().requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(shared(replace(layout, t_world_object=t)).sum(), t)
    return (slope != 0).any(-1)


def sharing(objects: Objects, layout: Layout) -> Callable[[Layout], Float[Tensor, " objects"]]:
    """How much of each object stands in others, for places near a layout (`prior_terms`) [1]."""
    pairs = _pairs(objects, layout)
    sections = {i: _sections(objects, i) for i in pairs.unique().tolist()}
    solids = gather_solids(objects, sections, pairs)
    return lambda at: apart_term(at, objects, solids)


def _pairs(objects: Objects, layout: Layout) -> Int[Tensor, "pairs 2"]:
    """Ordered pairs whose boxes are near each other, none carrying the other; on the CPU."""
    size = objects.size * layout.log_scale.exp()
    ends = corners(Box(layout.t_world_object, size, layout.yaw))[..., [0, 2]]
    middle = ends.mean(-2)
    reach = (ends - middle.unsqueeze(-2)).norm(dim=-1).amax(-1)
    gap = (middle[:, None] - middle[None]).norm(dim=-1) - reach[:, None] - reach[None]
    return (gap < NEAR).cpu().logical_and(~_related(objects)).nonzero()


def _related(objects: Objects) -> Bool[Tensor, "objects objects"]:
    n = len(objects.ids)
    related = torch.eye(n, dtype=torch.bool)
    for index, carrier in enumerate(objects.supports.tolist()):
        if carrier >= 0:
            related[index, carrier] = related[carrier, index] = True
    return related


def _sections(objects: Objects, index: int) -> Sections:
    """What an object fills, in its own frame."""
    faces = objects.faces[index]
    faces = faces[faces[:, 0] != faces[:, 1]]
    return sections_of(objects.verts[index][objects.real_verts[index]].float(), faces)


def place_objects(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Placed:
    """Minimise Eq. 1 over the layout, from one start or from many."""
    inputs = with_trees(inputs)
    found = descend(inputs, config, starts_left(inputs, config, observe), config.method, observe)
    for number in range(config.perturbation_rounds if config.perturbations else 0):
        around = shaken(best_few(found.at, found.value, 1), config.perturbations, number)
        more = descend(inputs, config, around, config.method, observe)
        found = Minimum(
            joined(found.at, more.at),
            torch.cat([found.value, more.value]),
            torch.cat([found.trace, more.trace]),
        )

    def lower(given: PlaceInputs, starts: Layout) -> Placed:
        return _best_first(descend(given, config, starts, config.method, observe), given, config)

    placed = line_up(_best_first(found, inputs, config), inputs, config.wall_alignment_steps, lower)
    if not config.apart:
        return placed
    energies = energy_of(with_walls(inputs, placed.walls), config)
    at = part_objects(energies, inputs.objects, placed.layout, config.apart, observe)
    return replace(placed, layout=standing(inputs, at))


def _best_first(found: Minimum[Layout], inputs: PlaceInputs, config: PlaceConfig) -> Placed:
    """The ends of descents, and the one of each object that is chosen."""
    candidates = best_few(found.at, found.value, len(found.value), apart=False)
    energy = found.value.sort(0).values
    at = choose(candidates, energy, inputs.reference, config.yaw_prior_weight)
    return Placed(at, candidates, energy, found.trace, inputs.image.walls)


def starts_left(inputs: PlaceInputs, config: PlaceConfig, observe: Observer = silent) -> Layout:
    """The starts of the main descents: spread, and thinned out by short descents."""
    starts = spread_distance(inputs.starts, config.distances)
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
    return best_few(found.at, found.value, config.num_hypotheses)


def without_search(config: PlaceConfig) -> PlaceConfig:
    """The same from the starts as they are."""
    return replace(config, yaws=1, distances=(), short=Adam(0))


def energy_of(inputs: PlaceInputs, config: PlaceConfig) -> Callable[[Layout], Energy]:
    """The energy as a function of layouts whose heights are still to be eliminated."""
    price = energy_function(*_evidence(inputs), priced(config))
    return lambda layout: price(standing(inputs, layout))


def priced(config: PlaceConfig) -> SceneConfig:
    """How the stage prices the room."""
    return SceneConfig(config.weights, config.form, config.uniform_scale_weight)


def _evidence(inputs: PlaceInputs) -> tuple[Objects, Camera, ImageCues, HumanCues]:
    return inputs.objects, inputs.camera, inputs.image, inputs.humans


def standing(inputs: PlaceInputs, layout: Layout) -> Layout:
    """The layout with what is pinned at its place, and the rest on its supports."""
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

    def at(free: Layout) -> Layout:
        return standing(inputs, free)

    def watched(step: Step) -> None:
        free = step.at
        assert free is not None
        observe(replace(step, at=lambda: moment(at(free()))))

    def moment(layout: Layout) -> Moment:
        return to_device(Moment(layout, inputs.camera, inputs.ground), "cpu")

    if isinstance(method, BatchedBFGS):
        found = settle(_problems(inputs, config, starts), method, watched, "place_objects")
    else:
        energy = energy_of(inputs, config)
        still = never_asks(inputs.objects)
        found = minimize(energy, starts, method, watched, "place_objects", still=still)
    return Minimum(at(found.at), found.value, found.trace)


def with_trees(inputs: PlaceInputs) -> PlaceInputs:
    """The inputs with search trees of what is touched, where these help."""
    humans = inputs.humans
    if humans.touches is None:
        return inputs
    trees = trees_of(inputs.objects, humans.touches)
    return replace(inputs, humans=replace(humans, trees=trees))


def _problems(inputs: PlaceInputs, config: PlaceConfig, begin: Layout) -> Problems[Layout]:
    """Each start of each object as a problem of its own; loads belong to their carriers."""
    starts, n = begin.yaw.shape
    some_energy = energy_of_rows(*_evidence(inputs), priced(config))
    objects = inputs.objects

    def of(rows: Tensor) -> Callable[[Layout], Energy]:
        index, energy = rows % n, some_energy(rows)
        supports, heights = some_supports(objects.supports, rows), objects.size[index, 1]
        pinned = inputs.pinned and of_objects(inputs.pinned, index, n)

        def price(free: Layout) -> Energy:
            held = hold(free, pinned)
            return energy(rest_on_support(held, supports, heights, inputs.ground))

        return price

    pile = piles_of(inputs.objects.supports)
    like = alike(begin, pile) * n + torch.arange(n).to(pile)
    if not bool((inputs.objects.supports >= 0).any()):
        return Problems(of, begin, (starts, n), None, like.flatten())
    group = pile + n * torch.arange(starts).to(pile)[:, None]
    return Problems(of, begin, (starts, n), group.flatten(), like.flatten())


def some_inputs(inputs: PlaceInputs, rows: Int[Tensor, " rows"]) -> PlaceInputs:
    """What placing whole piles needs, by the numbers of their objects."""
    n = len(inputs.objects.ids)
    few = of_objects(replace(inputs, humans=HumanCues()), rows, n)
    humans = of_objects(inputs.humans, rows, n)
    return replace(few, objects=some_objects(inputs.objects, rows), humans=humans)
