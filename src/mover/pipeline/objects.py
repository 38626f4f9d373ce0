"""The steps of the method that place objects: what each stage is given, and what becomes of it."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import to_device
from mover.core.run import Run
from mover.core.types import Camera, Capture, Layout, Objects
from mover.energy.config import Adam, SceneConfig, only
from mover.energy.fused.energy import energy_function
from mover.energy.objective import HumanCues, ImageCues
from mover.geometry.camera import to_camera
from mover.geometry.path import scaled
from mover.geometry.placement import larger, place, reproject, rest_on_support
from mover.pipeline.estimates import LOOSE
from mover.pipeline.people import HIGHEST, Located, lines_of
from mover.pipeline.presets import Config, with_sizes
from mover.stages.camera.refine_camera import RefineInputs, refine_camera
from mover.stages.camera.room_lines import Segments
from mover.stages.config import PlaceConfig
from mover.stages.contacts.assign_contacts import (
    AssignInputs,
    ContactAssignment,
    ContactInputs,
    assign_contacts,
    find_contacts,
)
from mover.stages.contacts.gather_cues import Cues, GatherInputs, cues_in_windows, gather_cues
from mover.stages.objects.find_image_cues import (
    ImageInputs,
    ObjectDetections,
    find_image_cues,
    image_evidence,
    order_in_image,
    order_of,
)
from mover.stages.objects.gather_depth import DepthImageInputs, gather_depth
from mover.stages.objects.gather_given import (
    UNFIT,
    bounded_sides,
    estimate_size_prior,
    gather_given,
    given_axis,
    inlier_weights,
    lighter_where_used,
    prior_weights,
)
from mover.stages.objects.own_edges import own_edges
from mover.stages.objects.place_inputs import Pinned, Placed, PlaceInputs, with_walls
from mover.stages.objects.place_objects import place_objects
from mover.stages.objects.prepare_objects import Prepared, PrepareInputs, prepare_objects
from mover.stages.objects.room_scale import ScaleKnown, common_scale, seat_height_estimate
from mover.stages.objects.seat_heights import SeatInputs, find_seat_heights, with_lifted_seats
from mover.stages.objects.starts import best_few, other_starts, reference_yaw, turned_to_people
from mover.stages.people.find_depth import are_shapeless, nearer, pelvis, size_spread

NO_PEOPLE = HumanCues()


@dataclass(frozen=True)
class Setup:
    """One capture under one configuration, with its objects prepared."""

    capture: Capture
    config: Config
    run: Run
    seen: ObjectDetections
    prepared: Prepared
    pinned: Bool[Tensor, " objects"]
    """The objects that stay where the capture has them."""
    segments: Segments | None
    """Straight edges of the reference image; None: they are not used."""

    @property
    def objects(self) -> Objects:
        """The closed proxies."""
        return self.prepared.objects


@dataclass(frozen=True)
class Arrangement:
    """Camera and ground, and the objects as they are placed under them."""

    camera: Camera
    ground: float
    image: ImageInputs
    start: Layout
    placed: Placed
    by_image: Layout
    """Where the image alone places the objects."""
    minimised: PlaceInputs
    """What the last descent minimised ..."""
    config: PlaceConfig
    """... and how."""
    traces: dict[str, Tensor]
    """Total energy before each step of the descents so far."""

    @property
    def layout(self) -> Layout:
        """Where the objects stand."""
        return self.placed.layout


@dataclass(frozen=True)
class ImageFit:
    """How well the image alone explains each object."""

    energy: Float[Tensor, " objects"]
    unfit: Bool[Tensor, " objects"]
    """Whose shapes do not fit: seats may be elsewhere in them."""


@dataclass(frozen=True)
class Humans:
    """What the people of all frames say of the room."""

    cues: Cues
    contacts: ContactAssignment


def prepare(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...]) -> Setup:
    """The closed proxies of the objects, and what the image shows of them."""
    prepared = run.stage(prepare_objects, PrepareInputs(capture.scene.objects), config.prepare)
    held = torch.tensor([name in pinned for name in prepared.objects.ids], dtype=torch.bool)
    seen, segments = image_evidence(capture), lines_of(capture, config)
    return Setup(capture, config, run, seen, prepared, held, segments)


def facing_people(setup: Setup, people: Located) -> Setup:
    """What was given with its back to the people turned round, where guesses are weighed."""
    if not setup.config.turn_to_people or not setup.config.place.weights.given:
        return setup
    prepared = setup.prepared
    positions = pelvis(people.bodies)[people.kept] @ setup.capture.scene.camera.R_cam_world
    turned = turned_to_people(prepared.start, prepared.objects.categories, positions)
    yaw = torch.where(setup.pinned, prepared.start.yaw, turned.yaw)
    return replace(setup, prepared=replace(prepared, start=replace(turned, yaw=yaw)))


def with_learnt_sizes(setup: Setup, placed: Arrangement) -> Setup:
    """The given sizes weighted as far as this room's furniture bears them out."""
    weights = inlier_weights(placed.placed.energy[0])
    learnt = estimate_size_prior(placed.layout, weights, setup.config.sizes)
    return replace(setup, config=with_sizes(setup.config, *learnt))


def place_by_image(
    setup: Setup, camera: Camera, ground: float, before: Arrangement | None = None
) -> Arrangement:
    """Carry the initial scene into this world and place the objects by the image alone."""
    objects, seen, capture = setup.objects, setup.seen, setup.capture
    searching, given = setup.config.layout, setup.prepared.start
    first = _carried(setup, given, capture.scene.camera, camera, ground)
    starts = first[None]
    if searching.num_hypotheses > 1 and before is not None:
        # Where the image has each object was searched: only the ends of that go down again.
        ends = best_few(before.placed.candidates, before.placed.energy, searching.num_hypotheses)
        ends = Layout.cat(before.layout[None], ends)
        starts = Layout.cat(starts, _carried(setup, ends, before.camera, camera, ground))
        searching = replace(searching, yaws=1, short=Adam(0))
    elif searching.num_hypotheses > 1 and capture.hypotheses:
        others = other_starts(capture.hypotheses, objects, given)
        starts = Layout.cat(starts, _carried(setup, others, capture.scene.camera, camera, ground))
    behind = order_in_image(seen.masks, seen.people) if before is None else before.image.behind
    image = ImageInputs(
        camera, seen.boxes, seen.detected, seen.masks, seen.people, behind,
        given.t_world_object.norm(dim=-1),
    )  # fmt: skip
    cues = setup.run.stage(find_image_cues, image, setup.config.image)
    cues = _with_prior(cues, setup, camera, before)
    if before is not None:  # the room as it was given does not give the scale of a depth
        cues = _with_measured(cues, setup, camera, ground, before.layout)
    inputs = PlaceInputs(
        objects, camera, ground, cues, NO_PEOPLE, starts, first.yaw, _pinned(setup, first)
    )
    placed = setup.run.stage(place_objects, inputs, searching)
    return Arrangement(
        camera, ground, image, first, placed, placed.layout, with_walls(inputs, placed.walls),
        searching, {"image": placed.trace},
    )  # fmt: skip


TURNED, RAISED = math.radians(0.05), 0.005  # [rad] and share of the height: less is no change


def refine_camera_and_objects(setup: Setup, people: Located, placed: Arrangement) -> Arrangement:
    """Camera and ground refined with the objects, and these placed again, until nothing changes.

    Where the feet leave the camera open, each round goes only a part of the way.
    """
    for _ in range(setup.config.refine.rounds):
        cues = setup.run.stage(find_image_cues, placed.image, setup.config.image)
        inputs = RefineInputs(
            placed.camera, placed.ground, people.alignment.posterior, setup.objects, cues,
            placed.layout,
        )  # fmt: skip
        better = setup.run.stage(refine_camera, inputs, setup.config.refine)
        found = place_by_image(setup, better.camera, better.ground, placed)
        traces = {**placed.traces, "camera": better.trace, **found.traces}
        turn = float((better.camera.R_cam_world - placed.camera.R_cam_world).norm()) / 2**0.5
        rise = abs(better.ground / placed.ground - 1)
        placed = replace(found, traces=traces)
        if turn < TURNED and rise < RAISED:
            break
    return placed


def image_fit(setup: Setup, placed: Arrangement) -> ImageFit:
    """What the image leaves of each object, and whose shapes do not fit it."""
    image, unfit = placed.minimised.image, torch.zeros_like(setup.pinned)
    if setup.config.seat_heights and image.given is not None:
        free = replace(image, sides=bounded_sides(image.sides, 0 * image.given.weight))
        unfit = (prior_weights(_misfit(setup, free, placed)) >= UNFIT) & ~setup.pinned
    return ImageFit(placed.placed.energy[0], unfit)


def estimate_scale(
    setup: Setup, people: Located, placed: Arrangement
) -> tuple[Located, Arrangement]:
    """The whole room larger or smaller where nothing but the furniture constrains its scale."""
    given, capture = placed.minimised.image.given, setup.capture
    heights = {} if capture.people is None else capture.people.heights
    known = bool(heights) or capture.camera_height is not None
    if given is None or known or not size_spread(people.bodies, setup.config.height_spread):
        return people, placed
    camera, (floor, loose) = placed.camera, people.alignment.ground_under(placed.camera)
    if max(floor, placed.ground) > HIGHEST:  # no room has its floor there: nothing to compare
        return people, placed
    larger_than_theirs = math.log(placed.ground / floor)  # the room as placed, than people's own
    seats = None
    if setup.config.seat_heights:
        seats = seat_height_estimate(people.in_world(camera), people.parts, floor)
    if seats is not None:
        seats = seats[0] + larger_than_theirs, seats[1]
    own = larger_than_theirs, loose / abs(floor)
    prior = ScaleKnown(own, capture.scene.size_spread, seats)
    scale, left = common_scale(placed.layout, given, setup.objects.categories, prior)
    factor = math.exp(-scale)
    warnings = people.warnings
    if left > LOOSE:
        warnings += (
            f"people's heights are not known, so the size of the whole room is uncertain by"
            f" {100 * left:.0f} %: the height of a person (mover fit --height, or 'heights' in"
            " people.json) or of the camera ('height' in camera.json) would fix it",
        )
    layout, candidates = (larger(x, factor) for x in (placed.layout, placed.placed.candidates))
    theirs = factor * placed.ground / floor
    bodies = nearer(people.bodies, camera, floor, theirs)
    path = scaled(people.path, theirs)
    return replace(people, bodies=bodies, path=path, warnings=warnings, size=left), replace(
        placed,
        ground=factor * placed.ground,
        start=larger(placed.start, factor),
        by_image=larger(placed.by_image, factor),
        placed=replace(placed.placed, layout=layout, candidates=candidates),
    )


def gather_humans(
    setup: Setup, people: Located, placed: Arrangement, before: Humans | None = None
) -> Humans:
    """Depth range and free space from all frames, and contacts, each given to an object.

    With `before`, only the contacts are assigned again, to the objects where they stand now.
    """
    bodies, capture, seen = people.in_world(placed.camera), setup.capture, setup.seen
    inputs = GatherInputs(bodies, capture.people, seen.masks, placed.camera, people.path)
    given = None if capture.touch is None else capture.touch[people.kept]
    touching = ContactInputs(bodies, people.parts, placed.ground, given)
    chance = setup.run.stage(find_contacts, touching, setup.config.contacts).probability
    assigned = AssignInputs(
        bodies, chance, people.parts, seen.masks, seen.boxes, placed.camera, setup.objects,
        placed.layout, capture.people,
    )  # fmt: skip
    contacts = setup.run.stage(assign_contacts, assigned, setup.config.assign)
    if before is not None:
        return replace(before, contacts=contacts)
    return Humans(setup.run.stage(gather_cues, inputs, setup.config.gather), contacts)


def ordered(setup: Setup, placed: Arrangement) -> Arrangement:
    """The placement with the depth order of the objects as they are placed now."""
    verts = place(setup.objects.verts, placed.layout)
    z = to_camera(verts, placed.camera.R_cam_world)[..., 2]
    return replace(placed, image=replace(placed.image, behind=order_of(z.amin(-1), z.amax(-1))))


def with_seats_lifted(
    setup: Setup, people: Located, placed: Arrangement, humans: Humans, fit: ImageFit
) -> Setup:
    """The seats of shapes that do not fit as high as the people assigned to them sit."""
    if not bool(fit.unfit.any()):
        return setup
    lift = find_seat_heights(SeatInputs(
        setup.objects, placed.layout, people.in_world(placed.camera), people.parts,
        placed.ground, humans.contacts.pairs, fit.unfit,
    ))  # fmt: skip
    return replace(setup, prepared=with_lifted_seats(setup.prepared, lift))


def place_by_all(
    setup: Setup, people: Located, placed: Arrangement, humans: Humans, fit: ImageFit
) -> Arrangement:
    """One descent of the whole of Eq. 1."""
    objects, config, contacts = setup.objects, setup.config, humans.contacts.points
    camera, ground = placed.camera, placed.ground
    image = setup.run.stage(find_image_cues, placed.image, config.image)
    image = _with_prior(image, setup, camera, placed)
    image = _with_measured(image, setup, camera, ground, placed.layout)
    if config.silhouette_confidence:
        image = replace(image, trust=inlier_weights(fit.energy))
        if image.given is not None and not are_shapeless(people.bodies):
            image = replace(image, given=lighter_where_used(image.given, image.trust, contacts))
    cues = cues_in_windows(humans.cues, contacts, image.views, camera)
    starts, count = placed.layout[None], config.layout.num_hypotheses
    if count > 1:
        different = best_few(placed.placed.candidates, placed.placed.energy, count)
        starts = Layout.cat(different, placed.layout[None])
    reference, pinned = reference_yaw(placed.start.yaw, contacts), _pinned(setup, placed.start)
    inputs = PlaceInputs(objects, camera, ground, image, cues, starts, reference, pinned)
    found = setup.run.stage(place_objects, inputs, config.place)
    traces = {**placed.traces, f"people {len(placed.traces)}": found.trace}
    minimised = with_walls(inputs, found.walls)
    return replace(placed, placed=found, minimised=minimised, config=config.place, traces=traces)


def _carried(setup: Setup, layout: Layout, old: Camera, camera: Camera, ground: float) -> Layout:
    """A layout of another camera's world in that of this camera, standing on this ground."""
    objects = setup.objects
    layout = reproject(layout, objects.size[:, 1], old.R_cam_world, camera.R_cam_world)
    return rest_on_support(layout, objects.supports, objects.size[:, 1], ground)


def _pinned(setup: Setup, first: Layout) -> Pinned | None:
    return Pinned(setup.pinned, first) if bool(setup.pinned.any()) else None


def _with_prior(
    image: ImageCues, setup: Setup, camera: Camera, before: Arrangement | None
) -> ImageCues:
    """The image's cues with what is known of the objects before they are seen.

    The first descent knows axes alone: what the image leaves there gives the weight of the rest.
    """
    objects, heading, capture = setup.objects, setup.capture.heading, setup.capture
    free = replace(image, sides=bounded_sides(image.sides, torch.zeros_like(image.trust)))
    if not setup.config.place.weights.given:
        return free
    edges = None
    if setup.segments is not None:
        edges = own_edges(setup.segments, setup.seen.masks, setup.seen.people, camera)
    if before is None:
        axes = None if heading is None else given_axis(objects.categories, heading, edges)
        return replace(free, given=to_device(axes, image.trust.device))
    old, first = capture.scene.camera.R_cam_world, setup.prepared.start
    given = reproject(first, objects.size[:, 1], old, camera.R_cam_world)
    misfit = _misfit(setup, free, before)
    known = gather_given(objects, given, before.layout, misfit, heading, edges)
    sides = bounded_sides(image.sides, known.weight, image.beside)
    return replace(image, given=known, sides=sides)


def _misfit(setup: Setup, image: ImageCues, placed: Arrangement) -> Float[Tensor, " objects"]:
    """What box and silhouette leave of each object where it stands."""
    config = SceneConfig(only(bbox=1.0, silhouette=1.0), "robust")
    energy = energy_function(setup.objects, placed.camera, image, NO_PEOPLE, config)
    return energy(placed.layout[None]).per_item[0].detach()


def _with_measured(
    image: ImageCues, setup: Setup, camera: Camera, ground: float, layout: Layout
) -> ImageCues:
    """The image's cues with the measured depth at the scale of the room as it stands now."""
    depth = setup.capture.depth
    if depth is None:
        return image
    hidden = setup.seen.masks.any(0) | setup.seen.people
    inputs = DepthImageInputs(depth, image, setup.objects, camera, ground, layout, hidden)
    return replace(image, measured=gather_depth(inputs))
