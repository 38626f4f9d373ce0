"""What the pipeline holds on its way, and the room that it returns."""

from dataclasses import dataclass, replace

from jaxtyping import Bool
from torch import Tensor

from .bodies.parts import Parts
from .bodies.world import in_world
from .calibration import calibration_of
from .explanation import explain
from .explanation_records import Explanation
from .presets import Config
from .readers.pose_file import into_camera
from .run import Run
from .stages.align_camera import Alignment
from .stages.assign_touches import Contacts
from .stages.doubt import DoubtInputs, doubts
from .stages.explain_placements import ExplainInputs, explain_placements
from .stages.find_image_cues import ImageInputs
from .stages.gather_cues import Cues
from .stages.inputs import Seen, rows_of
from .stages.place_objects import PlaceConfig, Placed, PlaceInputs
from .stages.prepare_objects import Prepared, proxy_meshes, restore
from .terms.feet import Soles
from .types import Bodies, Camera, Capture, Evidence, Layout, Room, Scene


@dataclass(frozen=True)
class Job:
    """One capture under one configuration."""

    capture: Capture
    config: Config
    run: Run
    seen: Seen
    prepared: Prepared
    pinned: tuple[str, ...] = ()
    """Ids of the objects that stay where the capture has them."""


@dataclass(frozen=True)
class Crew:
    """The people as the stages see them."""

    bodies: Bodies
    """All rows, in camera axes, at their corrected depth."""
    kept: Bool[Tensor, " bodies"]
    parts: Parts
    soles: Soles
    alignment: Alignment
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class View:
    """Camera and ground, and the room as it is placed under them."""

    camera: Camera
    ground: float
    image: ImageInputs
    start: Layout
    placed: Placed
    traces: dict[str, Tensor]
    """Total energy before each step of the descents so far."""
    alone: Layout
    """Where the image alone places the objects."""
    cues: Cues | None = None
    contacts: Contacts | None = None
    priced: tuple[PlaceInputs, PlaceConfig] | None = None
    """What the last descent minimised; None: nothing is explained."""


def carried(bodies: Bodies, camera: Camera) -> Bodies:
    """Bodies in the world, parameters included."""
    turned = into_camera(replace(bodies, space="world"), camera.R_cam_world.mT)
    return replace(turned, space="world")


def unfurnished(capture: Capture, crew: Crew | None) -> Room:
    """A room without objects still has a camera, a floor and people."""
    found = None if crew is None else crew.alignment
    camera = capture.scene.camera if found is None else found.camera
    scene = Scene(camera, capture.scene.ground if found is None else found.ground, ())
    warnings = (*capture.warnings, *(() if crew is None else crew.warnings))
    return Room(
        scene=scene, initial=capture.scene, image_only=scene,
        bodies=None if crew is None else carried(crew.bodies, camera),
        kept=None if crew is None else crew.kept, proxies=(), evidence=(),
        covariance=None if found is None else found.covariance, traces={}, warnings=warnings,
    )  # fmt: skip


def room_of(job: Job, view: View, crew: Crew | None) -> Room:
    """The room with the user's own meshes where the proxies ended, its people and its doubts."""
    capture, placed = job.capture, view.placed
    pieces = restore(capture.scene.pieces, job.prepared, placed.layout)
    alone = restore(capture.scene.pieces, job.prepared, view.alone)
    warnings = [*capture.warnings, *job.prepared.warnings]
    bodies = None
    if crew is not None:
        bodies = carried(crew.bodies, view.camera)
        warnings += crew.warnings
    if crew is not None and bodies is not None and view.contacts is not None:
        warnings += doubts(DoubtInputs(
            rows_of(bodies, crew.kept), crew.parts, capture.people, view.camera,
            job.prepared.objects, placed.layout, view.contacts.touches, view.contacts.seated_on,
        ))  # fmt: skip
    return Room(
        scene=Scene(view.camera, view.ground, pieces),
        initial=capture.scene,
        image_only=Scene(view.camera, view.ground, alone),
        bodies=bodies,
        kept=None if crew is None else crew.kept,
        proxies=proxy_meshes(job.prepared),
        evidence=_evidence(job, view),
        covariance=None if crew is None else crew.alignment.covariance,
        traces=view.traces,
        warnings=tuple(dict.fromkeys(warnings)),
        explanations=explanations_of(job, view, crew),
    )


def explanations_of(job: Job, view: View, crew: Crew | None) -> tuple[Explanation, ...]:
    """What holds each object, and how well its place is known."""
    if view.priced is None:
        return ()
    inputs, config = view.priced
    bodies = None if crew is None else in_world(rows_of(crew.bodies, crew.kept), view.camera)
    pairs = None if view.contacts is None else view.contacts.pairs
    tilt = None if crew is None else crew.alignment.covariance
    asked = ExplainInputs(inputs, config, view.placed, bodies, pairs, tilt)
    found = job.run.stage(explain_placements, asked, job.config.explain)
    return explain(found.facts, calibration_of(config.form))


def _evidence(job: Job, view: View) -> tuple[Evidence, ...]:
    ids = job.prepared.objects.ids
    near = far = bodies = (0,) * len(ids)
    if view.cues is not None and view.contacts is not None:
        near, far, bodies = view.cues.near_pixels, view.cues.far_pixels, view.contacts.touched_in
    pixels = job.seen.masks.sum((-2, -1)).tolist()
    lowest = view.placed.energy.amin(0).tolist()
    return tuple(Evidence(*row) for row in zip(ids, pixels, near, far, bodies, lowest, strict=True))
