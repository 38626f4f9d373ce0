"""What the pipeline holds on its way, and the room that it returns."""

from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import Parts
from mover.core.explanation import Explanation
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Camera, CameraPath, Capture, Evidence, Layout, Room, Scene
from mover.energy.terms.feet import FootContacts
from mover.evaluate.calibration import calibration_of
from mover.evaluate.explanation import explain
from mover.geometry.placement import place
from mover.io.capture.pose_file import into_camera
from mover.pipeline.presets import Config
from mover.stages.camera.align_camera import Alignment
from mover.stages.config import PlaceConfig
from mover.stages.contacts.assign_contacts import ContactAssignment, ContactInputs, find_contacts
from mover.stages.contacts.gather_cues import Cues
from mover.stages.contacts.propose_supports import (
    KnownTops,
    ProposeInputs,
    propose_supports,
)
from mover.stages.explain.diagnostics import DiagnosticInputs, diagnostics
from mover.stages.explain.placements import ExplainInputs, explain_placements
from mover.stages.objects.find_image_cues import ImageInputs, Seen
from mover.stages.objects.place_inputs import Placed, PlaceInputs
from mover.stages.objects.prepare_objects import Prepared, proxy_meshes, to_objects


@dataclass(frozen=True)
class ReconstructionContext:
    """One capture under one configuration."""

    capture: Capture
    config: Config
    run: Run
    seen: Seen
    prepared: Prepared
    pinned: tuple[str, ...] = ()
    """Ids of the objects that stay where the capture has them."""


@dataclass(frozen=True)
class PeopleState:
    """The people as the stages see them."""

    bodies: Bodies
    """All rows, in the axes of the reference image's camera, at their corrected depth."""
    path: CameraPath
    """Where the cameras of their frames were [m]."""
    kept: Bool[Tensor, " bodies"]
    parts: Parts
    foot_contacts: FootContacts
    alignment: Alignment
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class SceneState:
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
    contacts: ContactAssignment | None = None
    priced: tuple[PlaceInputs, PlaceConfig] | None = None
    """What the last descent minimised; None: nothing is explained."""


def to_world(bodies: Bodies, camera: Camera) -> Bodies:
    """Bodies in the world, parameters included."""
    turned = into_camera(replace(bodies, space="world"), camera.R_cam_world.mT)
    return replace(turned, space="world")


def unfurnished(capture: Capture, people: PeopleState | None) -> Room:
    """A room without objects still has a camera, a floor and people."""
    found = None if people is None else people.alignment
    camera = capture.scene.camera if found is None else found.camera
    ground = capture.scene.ground if found is None else found.ground
    scene = Scene(camera, ground, (), layout_over(capture.scene, ground))
    warnings = (*capture.warnings, *(() if people is None else people.warnings))
    return Room(
        scene=scene, initial=capture.scene, image_only=scene,
        bodies=None if people is None else to_world(people.bodies, camera),
        kept=None if people is None else people.kept, proxies=(), evidence=(),
        covariance=None if found is None else found.covariance, traces={}, warnings=warnings,
    )  # fmt: skip


def layout_over(given: Scene, ground: float | None) -> Float[Tensor, "4 2"] | None:
    """The corners that were given; their distances are as much larger as the floor is lower."""
    if given.layout is None or not given.ground or ground is None:
        return given.layout
    return given.layout * (ground / given.ground)


def room_of(context: ReconstructionContext, state: SceneState, people: PeopleState | None) -> Room:
    """The room with the user's own meshes where the proxies ended, its people and its doubts."""
    capture, placed = context.capture, state.placed
    pieces = to_objects(capture.scene.objects, context.prepared, placed.layout)
    alone = to_objects(capture.scene.objects, context.prepared, state.alone)
    warnings = [*capture.warnings, *context.prepared.warnings]
    bodies = None
    if people is not None:
        bodies = to_world(people.bodies, state.camera)
        warnings += people.warnings
    if people is not None and bodies is not None and state.contacts is not None:
        contacts = state.contacts
        warnings += diagnostics(DiagnosticInputs(
            rows_of(bodies, people.kept), people.parts, capture.people, state.camera,
            context.prepared.objects, placed.layout, contacts.points, contacts.seated_on,
            people.path,
        ))  # fmt: skip
    return Room(
        scene=Scene(state.camera, state.ground, pieces, layout_over(capture.scene, state.ground)),
        initial=capture.scene,
        image_only=Scene(state.camera, state.ground, alone),
        bodies=bodies,
        kept=None if people is None else people.kept,
        proxies=proxy_meshes(context.prepared),
        evidence=_evidence(context, state),
        covariance=None if people is None else people.alignment.covariance,
        traces=state.traces,
        warnings=tuple(dict.fromkeys(warnings)),
        explanations=explanations_of(context, state, people),
    )


def explanations_of(
    context: ReconstructionContext, state: SceneState, people: PeopleState | None
) -> tuple[Explanation, ...]:
    """What holds each object, and how well its place is known."""
    if state.priced is None:
        return ()
    inputs, config = state.priced
    bodies = None if people is None else in_world(rows_of(people.bodies, people.kept), state.camera)
    pairs = None if state.contacts is None else state.contacts.pairs
    tilt = None if people is None else people.alignment.covariance
    asked = ExplainInputs(inputs, config, state.placed, bodies, pairs, tilt)
    found = context.run.stage(explain_placements, asked, context.config.explain)
    return explain(found.facts, calibration_of(config.form))


def with_proposals(
    room: Room,
    capture: Capture,
    config: Config,
    run: Run,
    people: PeopleState | None,
    known: KnownTops,
) -> Room:
    """The room with what people rest on that is not in it."""
    camera, ground = room.scene.camera, room.scene.ground
    if people is None or ground is None or not config.propose.use:
        return room
    bodies = in_world(rows_of(people.bodies, people.kept), camera)
    given = None if capture.touch is None else capture.touch[people.kept]
    contacts = ContactInputs(bodies, people.parts, ground, given)
    chance = run.stage(find_contacts, contacts, config.contacts).probability
    inputs = ProposeInputs(bodies, people.parts, chance, ground, camera, known)
    found = run.stage(propose_supports, inputs, config.propose).found
    sentences = (
        f"{one.object.id}: people rest for {one.seconds:.0f} s on nothing that is known; a"
        f" {one.object.category} is proposed there (certainty {one.certainty:.2f})"
        for one in found
    )
    return replace(room, proposals=found, warnings=(*room.warnings, *sentences))


def tops_of(context: ReconstructionContext, state: SceneState) -> KnownTops:
    """What of the placed room can carry people."""
    objects = context.prepared.objects
    rows = objects.has_top.nonzero()[:, 0]
    tops = place(objects.top, state.placed.layout)[rows]
    return KnownTops(tops, context.seen.masks[rows], objects.is_seat[rows], objects.ids)


def _evidence(context: ReconstructionContext, state: SceneState) -> tuple[Evidence, ...]:
    ids = context.prepared.objects.ids
    near = far = bodies = (0,) * len(ids)
    if state.cues is not None and state.contacts is not None:
        near, far, bodies = state.cues.near_pixels, state.cues.far_pixels, state.contacts.bodies
    pixels = context.seen.masks.sum((-2, -1)).tolist()
    lowest = state.placed.energy.amin(0).tolist()
    return tuple(Evidence(*row) for row in zip(ids, pixels, near, far, bodies, lowest, strict=True))
