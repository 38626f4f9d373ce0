"""The order of the stages, each kept on disk: from a capture to a consistent room."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .bodies.parts import parts_of
from .bodies.world import in_world
from .energy import HumanCues
from .geometry.camera import to_camera
from .geometry.floor import recast, slide_to_floor
from .geometry.placement import GROUND, place, stand
from .outcome import Crew, Job, View, room_of, unfurnished
from .presets import PRESETS as PRESETS
from .presets import Config as Config
from .presets import with_sizes
from .run import Run as Run
from .stages.align_camera import AlignInputs, align_camera
from .stages.assign_touches import TouchInputs, assign_touches
from .stages.find_depth import DepthInputs, apply_depth, find_depth
from .stages.find_focal import FocalInputs, find_focal, zoomed
from .stages.find_image_cues import ImageInputs, find_image_cues, order_of
from .stages.find_soles import SolesInputs, find_soles
from .stages.find_touches import FindTouchesInputs, find_touches
from .stages.gather_cues import GatherInputs, cues_in_windows, gather_cues
from .stages.inputs import (
    detected_masks,
    ground_without_people,
    image_evidence,
    rows_of,
)
from .stages.other_starts import other_starts
from .stages.pinned import Pinned
from .stages.place_inputs import with_walls
from .stages.place_objects import PlaceInputs, place_objects
from .stages.prepare_objects import PrepareInputs, prepare_objects
from .stages.refine_camera import RefineInputs, refine_camera
from .stages.reinitialize import ReinitInputs, by_release, contact_start
from .stages.select_frames import SelectInputs, select_frames
from .stages.size_spread import believed, learnt_sizes
from .stages.starts import alone, best_few, joined, reference_yaw
from .types import Camera, Capture, Layout, Room

NOBODY = HumanCues()


def reconstruct(capture: Capture, config: Config, run: Run, pinned: tuple[str, ...] = ()) -> Room:
    """From a capture to a consistent room (Sec. 3); `pinned` objects stay where they start."""
    crew = people_of(capture, config, run)
    if not capture.scene.pieces:
        return unfurnished(capture, crew)
    seen = image_evidence(capture)
    prepared = run.stage(prepare_objects, PrepareInputs(capture.scene.pieces), config.prepare)
    job = Job(capture, config, run, seen, prepared, pinned)
    if crew is None:
        view = _from_image(job, capture.scene.camera, ground_without_people(capture, prepared))
        return room_of(job, view, None)
    view = _from_image(job, crew.alignment.camera, crew.alignment.ground)
    job = _with_sizes(job, view)
    for _ in range(config.refine.rounds):
        view = _refine(job, crew, view)
    return room_of(job, _with_people(job, crew, view), crew)


def _with_sizes(job: Job, view: View) -> Job:
    """The given sizes believed as far as this room's furniture bears them out."""
    placed = view.placed
    learnt = learnt_sizes(placed.layout, believed(placed.energy[0]), job.config.sizes)
    return replace(job, config=with_sizes(job.config, *learnt))


def people_of(capture: Capture, config: Config, run: Run) -> Crew | None:
    """Choose frames, find the people's depth and their feet, and from these camera and ground."""
    bodies, scene = capture.bodies, capture.scene
    if bodies is None:
        return None
    parts = parts_of(bodies, scene.camera.R_cam_world[:, 1])
    kept = run.stage(select_frames, SelectInputs(bodies), config.select).keep
    camera, warnings = _with_lens(capture, kept, config, run)
    if config.correct_depth and capture.people is not None:
        inputs = DepthInputs(bodies, parts, kept, capture.people, detected_masks(capture), camera)
        depth = run.stage(find_depth, inputs, config.depth)
        bodies, warnings = apply_depth(bodies, depth), (*warnings, *depth.warnings)
    soles = run.stage(find_soles, SolesInputs(bodies, parts, kept, camera), config.soles)
    feet = AlignInputs(soles, camera, scene.ground, capture.camera_height)
    alignment = run.stage(align_camera, feet, config.align)
    warnings = (*warnings, *soles.warnings, *alignment.warnings)
    return Crew(bodies, kept, parts, soles, alignment, warnings)


def _with_lens(
    capture: Capture, kept: Bool[Tensor, " bodies"], config: Config, run: Run
) -> tuple[Camera, tuple[str, ...]]:
    """The given camera, with the focal length that the people tell where one is looked for."""
    camera, bodies, people = capture.scene.camera, capture.bodies, capture.people
    if config.focal.spread <= 0 or bodies is None or people is None:
        return camera, ()
    inputs = FocalInputs(bodies, kept, people, detected_masks(capture), camera)
    lens = run.stage(find_focal, inputs, config.focal)
    return zoomed(camera, lens), lens.warnings


def _from_image(job: Job, camera: Camera, ground: float) -> View:
    """Carry the initial scene into this world and place the objects by the image alone."""
    objects, seen = job.prepared.objects, job.seen
    old = job.capture.scene.camera.R_cam_world

    def carried(layout: Layout) -> Layout:
        there = recast(layout, objects.size[:, 1], old, camera.R_cam_world)
        if job.config.slide:
            there = slide_to_floor(there, ground, (objects.supports == GROUND) & ~_is_pinned(job))
        return stand(there, objects.supports, objects.size[:, 1], ground)

    start = carried(job.prepared.start)
    starts = alone(start)
    if job.config.layout.keep > 1 and job.capture.hypotheses:
        others = other_starts(job.capture.hypotheses, objects, job.prepared.start)
        starts = joined(starts, carried(others))
    unordered = torch.zeros(len(objects.ids), len(objects.ids), dtype=torch.bool)
    given = job.prepared.start.t_world_object.norm(dim=-1)
    image = ImageInputs(
        camera, seen.boxes, seen.detected, seen.masks, seen.people, unordered, given
    )
    cues = job.run.stage(find_image_cues, image, job.config.image)
    inputs = PlaceInputs(
        objects, camera, ground, cues, NOBODY, starts, start.yaw, _pinned(job, start)
    )
    placed = job.run.stage(place_objects, inputs, job.config.layout)
    found = View(camera, ground, image, start, placed, {"image": placed.trace}, placed.layout)
    return replace(found, priced=(with_walls(inputs, placed.walls), job.config.layout))


def _refine(job: Job, crew: Crew, view: View) -> View:
    """Camera and ground refined with the objects, and the objects placed anew under them."""
    cues = job.run.stage(find_image_cues, view.image, job.config.image)
    spread, objects = crew.alignment.covariance, job.prepared.objects
    inputs = RefineInputs(view.camera, view.ground, spread, objects, cues, view.placed.layout)
    better = job.run.stage(refine_camera, inputs, job.config.refine)
    found = _from_image(job, better.camera, better.ground)
    return replace(found, traces={**view.traces, "camera": better.trace, **found.traces})


def _with_people(job: Job, crew: Crew, view: View) -> View:
    """Gather what the people say, and place the objects with it; renew both as often as asked."""
    view = gathered(job, crew, view)
    fit = view.placed.energy[0]
    for turn in range(1 + job.config.again):
        if turn:
            view = replace(view, image=replace(view.image, behind=_order(job, view)))
        view = _place_with(job, assigned(job, crew, view), fit)
    return view


def gathered(job: Job, crew: Crew, view: View) -> View:
    """The view with depth maps and free space from all frames."""
    bodies = in_world(rows_of(crew.bodies, crew.kept), view.camera)
    inputs = GatherInputs(bodies, job.capture.people, job.seen.masks, view.camera)
    return replace(view, cues=job.run.stage(gather_cues, inputs, job.config.gather))


def assigned(job: Job, crew: Crew, view: View) -> View:
    """The view with contact points, each given to an object where it stands now."""
    bodies = in_world(rows_of(crew.bodies, crew.kept), view.camera)
    given = None if job.capture.touch is None else job.capture.touch[crew.kept]
    inputs = FindTouchesInputs(bodies, crew.parts, view.ground, given)
    touching = job.run.stage(find_touches, inputs, job.config.touches)
    touches = TouchInputs(
        bodies, touching.probability, crew.parts, job.seen.masks, job.seen.boxes, view.camera,
        job.prepared.objects, view.placed.layout, job.capture.people,
    )  # fmt: skip
    return replace(view, contacts=job.run.stage(assign_touches, touches, job.config.assign))


def _place_with(job: Job, view: View, fit: Float[Tensor, " objects"]) -> View:
    """One descent of the whole of Eq. 1."""
    objects, config, run = job.prepared.objects, job.config, job.run
    assert view.cues is not None
    assert view.contacts is not None
    touches = view.contacts.touches
    image = run.stage(find_image_cues, view.image, config.image)
    humans = cues_in_windows(view.cues, touches, image.views, view.camera)
    if config.trust:
        image = replace(image, trust=believed(fit))
    seats = ReinitInputs(objects, view.camera, humans, image.masks, view.placed.layout)
    starts = alone(run.stage(by_release, seats, config.reinit))
    if config.layout.keep > 1:
        contact = contact_start(view.placed.layout, objects, touches)
        different = best_few(view.placed.candidates, view.placed.energy, config.layout.keep)
        starts = joined(different, alone(contact))
    reference = reference_yaw(view.start.yaw, touches)
    inputs = PlaceInputs(
        objects, view.camera, view.ground, image, humans, starts, reference,
        _pinned(job, view.start),
    )  # fmt: skip
    placed = run.stage(place_objects, inputs, config.place)
    traces = {**view.traces, f"people {len(view.traces)}": placed.trace}
    priced = with_walls(inputs, placed.walls), config.place
    return replace(view, placed=placed, traces=traces, priced=priced)


def _is_pinned(job: Job) -> Bool[Tensor, " objects"]:
    return torch.tensor([name in job.pinned for name in job.prepared.objects.ids], dtype=torch.bool)


def _pinned(job: Job, start: Layout) -> Pinned | None:
    return Pinned(_is_pinned(job), start) if job.pinned else None


def _order(job: Job, view: View) -> Bool[Tensor, "objects objects"]:
    verts = place(job.prepared.objects.verts, view.placed.layout)
    z = to_camera(verts, view.camera.R_cam_world)[..., 2]
    return order_of(z.amin(-1), z.amax(-1))
