"""The order of the stages, each kept on disk: from a capture to a consistent room."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.core.observe import Observer
from mover.core.records import rows_of, to_device
from mover.core.run import Conf, In
from mover.core.run import Run as Run
from mover.core.settings import check_settings
from mover.core.types import Camera, Capture, Layout, Room
from mover.energy.config import Adam, SceneConfig, only
from mover.energy.fused.energy import energy_function
from mover.energy.objective import HumanCues, ImageCues
from mover.geometry.warp_start import threads
from mover.io.capture.plausible import check_plausible
from mover.pipeline.outcome import (
    PeopleState,
    ReconstructionContext,
    SceneState,
    as_given,
    carried,
    check_floor,
    check_room,
    gather_inputs,
    is_pinned,
    label_inputs,
    room_of,
    scale_spread,
    unfurnished,
    with_fronts,
    with_order,
)
from mover.pipeline.people import lines_of, people_of, through_its_lens
from mover.pipeline.presets import PRESETS as PRESETS
from mover.pipeline.presets import Config as Config
from mover.pipeline.presets import with_sizes
from mover.pipeline.sitters import with_common_scale, with_seats_lifted
from mover.stages.camera.refine_camera import RefineInputs, refine_camera
from mover.stages.contacts.assign_contacts import ContactInputs, assign_contacts, find_contacts
from mover.stages.contacts.contact_association import AssignInputs
from mover.stages.contacts.gather_cues import cues_in_windows, gather_cues
from mover.stages.contacts.label_contacts import LabelConfig, label_contacts
from mover.stages.objects.find_image_cues import (
    ImageInputs,
    find_image_cues,
    ground_without_people,
    image_evidence,
)
from mover.stages.objects.gather_depth import DepthInputs, gather_depth
from mover.stages.objects.gather_given import (
    UNFIT,
    bounded_sides,
    gather_given,
    given_axis,
    lighter_where_used,
    prior_weights,
)
from mover.stages.objects.own_edges import OwnEdges, own_edges
from mover.stages.objects.place_inputs import Pinned, PlaceInputs, with_walls
from mover.stages.objects.place_objects import (
    place_objects,
)
from mover.stages.objects.prepare_objects import PrepareInputs, prepare_objects
from mover.stages.objects.size_prior import estimate_size_prior, inlier_weights
from mover.stages.objects.starts import (
    best_few,
    other_starts,
    reference_yaw,
)
from mover.stages.people.find_depth import are_shapeless

NOBODY = HumanCues()


def reconstruct(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...] = ()) -> Room:
    """From a capture to a consistent room (Sec. 3); `pinned` objects stay where they start.

    Raises:
        InputError: If a setting is out of its range, the capture cannot be true, or the result.
    """
    check_settings(config, "config")
    told: list[str] = []
    check_plausible(capture, told.append)
    capture = replace(capture, warnings=tuple(dict.fromkeys((*capture.warnings, *told))))
    if capture.scene.objects:
        _begin(run, prepare_objects, PrepareInputs(capture.scene.objects), config.prepare)
    given, capture = capture.scene, through_its_lens(capture, config, run, pinned)
    room = check_room(_reconstructed(capture, config, run, pinned))
    return replace(room, initial=given)


def _reconstructed(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...]) -> Room:
    """The stages in their order."""
    furniture = PrepareInputs(capture.scene.objects)
    if capture.scene.objects:
        _begin(run, prepare_objects, furniture, config.prepare)
    people = people_of(capture, config, run)
    if not capture.scene.objects:
        return unfurnished(capture, people)
    seen = image_evidence(capture)
    prepared = run.stage(prepare_objects, furniture, config.prepare)
    context = ReconstructionContext(
        capture, config, run, seen, prepared, pinned, segments=lines_of(capture, config)
    )
    if people is None:
        ground = ground_without_people(capture, prepared)
        check_floor(ground, capture)
        state = placed_by_image(context, capture.scene.camera, ground)
        return room_of(context, state, None)
    context = with_fronts(context, people)
    state = placed_by_image(context, people.alignment.camera, people.alignment.ground)
    context = with_size_prior(context, state)
    for _ in range(config.refine.rounds):
        state = with_refined_camera(context, people, state)
    if not scale_spread(context, people):
        _begin(run, gather_cues, gather_inputs(context, people, state), config.gather)
    image_energy = state.placed.energy[0]
    context = with_unfit_shapes(context, state)
    people, state = with_common_scale(context, people, state)
    _begin(run, gather_cues, gather_inputs(context, people, state), config.gather)
    state = gathered(context, people, assigned(context, people, state))
    context, state = _by_people(context, people, state, image_energy)
    for _ in range(config.outer_iterations):
        state = assigned(context, people, with_order(context, state))
        context, state = _by_people(context, people, state, image_energy)
    room = room_of(context, state, people)
    if context.capture.furniture is None:  # nothing of it will move
        _begin(context.run, label_contacts, label_inputs(room), LabelConfig())
    return room


def _by_people(
    context: ReconstructionContext,
    people: PeopleState,
    state: SceneState,
    image_energy: Float[Tensor, " objects"],
) -> tuple[ReconstructionContext, SceneState]:
    """Seats where people have them, then all placed beside the people."""
    context = with_seats_lifted(context, people, state)
    return context, placed_with_people(context, people, state, image_energy)


def with_size_prior(context: ReconstructionContext, state: SceneState) -> ReconstructionContext:
    """The given sizes believed as far as this room's furniture bears them out."""
    weights = inlier_weights(state.placed.energy[0])
    learnt = estimate_size_prior(state.placed.layout, weights, context.config.sizes)
    return replace(context, config=with_sizes(context.config, *learnt))


def placed_by_image(
    context: ReconstructionContext,
    camera: Camera,
    ground: float,
    before: SceneState | None = None,
) -> SceneState:
    """Carry the initial scene into this world and place the objects by the image alone."""
    objects, seen, capture = context.prepared.objects, context.seen, context.capture
    here, searching = (camera, ground), context.config.layout
    start = carried(context, context.prepared.start, capture.scene.camera, here)
    starts = start[None]
    if searching.num_hypotheses > 1 and before is not None:
        # Where the image has each object was searched: only the ends of that go down again.
        ends = best_few(before.placed.candidates, before.placed.energy, searching.num_hypotheses)
        ends = Layout.cat(before.placed.layout[None], ends)
        starts = Layout.cat(starts, carried(context, ends, before.camera, here))
        searching = replace(searching, yaws=1, short=Adam(0))
    elif searching.num_hypotheses > 1 and capture.hypotheses:
        others = other_starts(capture.hypotheses, objects, context.prepared.start)
        starts = Layout.cat(starts, carried(context, others, capture.scene.camera, here))
    unordered = torch.zeros(len(objects.ids), len(objects.ids), dtype=torch.bool)
    given = context.prepared.start.t_world_object.norm(dim=-1)
    image = ImageInputs(
        camera, seen.boxes, seen.detected, seen.masks, seen.people, unordered, given
    )
    cues = context.run.stage(find_image_cues, image, context.config.image)
    cues = with_given(cues, context, camera, before)
    if before is not None:  # the room as it was given does not tell the scale of a depth
        cues = with_measured(cues, context, here, before.placed.layout)
    inputs = PlaceInputs(
        objects, camera, ground, cues, NOBODY, starts, start.yaw, _pinned(context, start)
    )
    placed = context.run.stage(place_objects, inputs, searching)
    descent = with_walls(inputs, placed.walls), searching
    return SceneState(
        camera, ground, image, start, placed, {"image": placed.trace}, placed.layout, descent,
    )  # fmt: skip


def with_given(
    image: ImageCues, context: ReconstructionContext, camera: Camera, before: SceneState | None
) -> ImageCues:
    """The image's cues with what is known of the objects before they are seen.

    The first descent knows axes alone: what the image leaves there tells how far the rest is
    believed.
    """
    objects, heading = context.prepared.objects, context.capture.heading
    free = replace(image, sides=bounded_sides(image.sides, torch.zeros_like(image.trust)))
    if not context.config.place.weights.given:
        return free
    edges = edges_under(context, camera)
    if before is None:
        axes = None if heading is None else given_axis(objects.categories, heading, edges)
        return replace(free, given=to_device(axes, image.trust.device))
    left = misfit_of(context, free, before)
    given, layout = as_given(context, camera), before.placed.layout
    known = gather_given(objects, given, layout, left, heading, edges)
    return replace(image, given=known, sides=bounded_sides(image.sides, known.weight, image.beside))


def edges_under(context: ReconstructionContext, camera: Camera) -> OwnEdges | None:
    """The furniture's own edges, under a camera."""
    if context.segments is None:
        return None
    return own_edges(context.segments, context.seen.masks, context.seen.people, camera)


def misfit_of(
    context: ReconstructionContext, image: ImageCues, state: SceneState
) -> Float[Tensor, " objects"]:
    """What box and silhouette leave of each object where it stands."""
    config = SceneConfig(only(bbox=1.0, silhouette=1.0), "robust")
    energy = energy_function(context.prepared.objects, state.camera, image, NOBODY, config)
    return energy(state.placed.layout[None]).per_item[0].detach()


def with_unfit_shapes(context: ReconstructionContext, state: SceneState) -> ReconstructionContext:
    """Which shapes do not fit the image, where seats may be raised in them."""
    image = state.descent[0].image
    if not context.config.seat_heights or image.given is None:
        return context
    free = replace(image, sides=bounded_sides(image.sides, 0 * image.given.weight))
    unfit = prior_weights(misfit_of(context, free, state)) >= UNFIT
    return replace(context, unfit=unfit & ~is_pinned(context))


def with_measured(
    image: ImageCues, context: ReconstructionContext, view: tuple[Camera, float], now: Layout
) -> ImageCues:
    """The image's cues with the measured depth at the scale of the room as it stands now."""
    depth, (camera, ground) = context.capture.depth, view
    if depth is None:
        return image
    hidden = context.seen.masks.any(0) | context.seen.people
    objects = context.prepared.objects
    inputs = DepthInputs(depth, image, objects, camera, ground, now, hidden)
    return replace(image, measured=gather_depth(inputs))


def with_refined_camera(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> SceneState:
    """Camera and ground refined with the objects, and the objects placed anew under them."""
    cues = context.run.stage(find_image_cues, state.image, context.config.image)
    spread, objects = people.alignment.covariance, context.prepared.objects
    inputs = RefineInputs(state.camera, state.ground, spread, objects, cues, state.placed.layout)
    better = context.run.stage(refine_camera, inputs, context.config.refine)
    found = placed_by_image(context, better.camera, better.ground, state)
    traces = {**state.traces, "camera": better.trace, **found.traces}
    return replace(found, traces=traces)


def _begin(run: Run, fn: Callable[[In, Conf, Observer], object], inputs: In, config: Conf) -> None:
    """Begin a stage beside the next ones where there is a second thread for it."""
    if threads() > 1:
        run.begin(fn, inputs, config)


def gathered(context: ReconstructionContext, people: PeopleState, state: SceneState) -> SceneState:
    """The state with depth maps and free space from all frames."""
    inputs = gather_inputs(context, people, state)
    return replace(state, cues=context.run.stage(gather_cues, inputs, context.config.gather))


def assigned(context: ReconstructionContext, people: PeopleState, state: SceneState) -> SceneState:
    """The state with contact points, each given to an object where it stands now."""
    bodies = in_world(rows_of(people.bodies, people.kept), state.camera)
    capture, config, seen, run = context.capture, context.config, context.seen, context.run
    given = None if capture.touch is None else capture.touch[people.kept]
    inputs = ContactInputs(bodies, people.parts, state.ground, given)
    chance = run.stage(find_contacts, inputs, config.contacts).probability
    contacts = AssignInputs(
        bodies, chance, people.parts, seen.masks, seen.boxes, state.camera,
        context.prepared.objects, state.placed.layout, capture.people,
    )  # fmt: skip
    return replace(state, contacts=run.stage(assign_contacts, contacts, config.assign))


def placed_with_people(
    context: ReconstructionContext,
    people: PeopleState,
    state: SceneState,
    image_energy: Float[Tensor, " objects"],
) -> SceneState:
    """One descent of the whole of Eq. 1."""
    objects, config, run = context.prepared.objects, context.config, context.run
    assert state.cues is not None
    assert state.contacts is not None
    contacts = state.contacts.points
    image = run.stage(find_image_cues, state.image, config.image)
    image = with_given(image, context, state.camera, state)
    view = state.camera, state.ground
    image = with_measured(image, context, view, state.placed.layout)
    humans = cues_in_windows(state.cues, contacts, image.views, state.camera)
    if config.silhouette_confidence:
        image = replace(image, trust=inlier_weights(image_energy))
        if image.given is not None and not are_shapeless(people.bodies):
            image = replace(image, given=lighter_where_used(image.given, image.trust, contacts))
    starts = state.placed.layout[None]
    if config.layout.num_hypotheses > 1:
        placed = state.placed
        different = best_few(placed.candidates, placed.energy, config.layout.num_hypotheses)
        starts = Layout.cat(different, state.placed.layout[None])
    reference = reference_yaw(state.start.yaw, contacts)
    inputs = PlaceInputs(
        objects, state.camera, state.ground, image, humans, starts, reference,
        _pinned(context, state.start),
    )  # fmt: skip
    placed = run.stage(place_objects, inputs, config.place)
    traces = {**state.traces, f"people {len(state.traces)}": placed.trace}
    descent = with_walls(inputs, placed.walls), config.place
    return replace(state, placed=placed, traces=traces, descent=descent)


def _pinned(context: ReconstructionContext, start: Layout) -> Pinned | None:
    return Pinned(is_pinned(context), start) if context.pinned else None
