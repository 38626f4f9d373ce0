"""What the pipeline holds on its way, and the room that it returns."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import Parts, parts_of
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import (
    Bodies,
    Camera,
    CameraPath,
    Capture,
    Evidence,
    Layout,
    Room,
    Scene,
)
from mover.energy.human_terms import FootContacts
from mover.geometry.camera import to_camera
from mover.geometry.placement import (
    place,
    reproject,
    rest_on_support,
    standing_meshes,
)
from mover.geometry.volume import sample
from mover.io.capture.pose_file import into_camera
from mover.pipeline.presets import Config
from mover.stages.camera.align_camera import Alignment
from mover.stages.camera.room_lines import Segments
from mover.stages.config import PlaceConfig
from mover.stages.contacts.assign_contacts import ContactAssignment
from mover.stages.contacts.diagnostics import DiagnosticInputs, diagnostics
from mover.stages.contacts.gather_cues import Cues, GatherInputs
from mover.stages.contacts.label_contacts import LabelInputs
from mover.stages.objects.find_image_cues import ImageInputs, Seen, order_of
from mover.stages.objects.fronts import turned_to_people
from mover.stages.objects.place_inputs import Placed, PlaceInputs
from mover.stages.objects.place_objects import energy_of, with_trees
from mover.stages.objects.prepare_objects import Prepared, proxy_meshes, to_objects
from mover.stages.objects.seat_heights import seat_warnings
from mover.stages.people.find_depth import pelvis, size_spread


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
    unfit: Bool[Tensor, " objects"] | None = None
    """Whose shapes do not fit the image: seats may be elsewhere in them; None: not asked."""
    segments: Segments | None = None
    """Straight edges of the reference image; None: nobody looks for them."""


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
    descent: tuple[PlaceInputs, PlaceConfig]
    """What the last descent minimised, and how."""
    cues: Cues | None = None
    contacts: ContactAssignment | None = None


def as_given(context: ReconstructionContext, camera: Camera) -> Layout:
    """The initial scene in the world of another camera; objects may hang in the air."""
    objects, old = context.prepared.objects, context.capture.scene.camera.R_cam_world
    return reproject(context.prepared.start, objects.size[:, 1], old, camera.R_cam_world)


def carried(
    context: ReconstructionContext, layout: Layout, old: Camera, here: tuple[Camera, float]
) -> Layout:
    """A layout of another camera's world in that of this camera, standing on this ground."""
    objects, (camera, ground) = context.prepared.objects, here
    there = reproject(layout, objects.size[:, 1], old.R_cam_world, camera.R_cam_world)
    return rest_on_support(there, objects.supports, objects.size[:, 1], ground)


def is_pinned(context: ReconstructionContext) -> Bool[Tensor, " objects"]:
    """The objects that stay where the capture has them."""
    ids = context.prepared.objects.ids
    return torch.tensor([name in context.pinned for name in ids], dtype=torch.bool)


def with_fronts(context: ReconstructionContext, people: PeopleState) -> ReconstructionContext:
    """What was given with its back to the people turned round, where guesses are weighed."""
    if not context.config.turn_to_people or not context.config.place.weights.given:
        return context
    prepared = context.prepared
    places = pelvis(people.bodies)[people.kept] @ context.capture.scene.camera.R_cam_world
    start = turned_to_people(prepared.start, prepared.objects.categories, places)
    yaw = torch.where(is_pinned(context), prepared.start.yaw, start.yaw)
    return replace(context, prepared=replace(prepared, start=replace(start, yaw=yaw)))


def with_order(context: ReconstructionContext, state: SceneState) -> SceneState:
    """The state with what stands behind what, as the objects are placed now."""
    verts = place(context.prepared.objects.verts, state.placed.layout)
    z = to_camera(verts, state.camera.R_cam_world)[..., 2]
    behind = order_of(z.amin(-1), z.amax(-1))
    return replace(state, image=replace(state.image, behind=behind))


def scale_spread(context: ReconstructionContext, people: PeopleState) -> float:
    """How far off the room's scale may be (of the logarithm); 0: not only the furniture tells."""
    capture = context.capture
    heights = {} if capture.people is None else capture.people.heights
    if heights or capture.camera_height is not None:
        return 0.0
    return size_spread(people.bodies, context.config.height_spread)


def gather_inputs(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> GatherInputs:
    """The people in the world, and the masks."""
    bodies = in_world(rows_of(people.bodies, people.kept), state.camera)
    return GatherInputs(
        bodies, context.capture.people, context.seen.masks, state.camera, people.path
    )


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
        path=capture.path if people is None else people.path,
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
    by_image = to_objects(capture.scene.objects, context.prepared, state.alone)
    warnings = [*capture.warnings, *context.prepared.warnings, *seat_warnings(pieces)]
    bodies = None
    if people is not None:
        bodies = to_world(people.bodies, state.camera)
        warnings += people.warnings
    if people is not None and bodies is not None and state.contacts is not None:
        contacts, now = state.contacts, people.kept
        warnings += diagnostics(DiagnosticInputs(
            rows_of(bodies, now), people.parts, capture.people, state.camera,
            context.prepared.objects, placed.layout, contacts.points,
            contacts.seated_on[now[people.kept]], people.path,
        ))  # fmt: skip
    return Room(
        scene=Scene(state.camera, state.ground, pieces, layout_over(capture.scene, state.ground)),
        initial=capture.scene,
        image_only=Scene(state.camera, state.ground, by_image),
        bodies=bodies,
        kept=None if people is None else people.kept,
        proxies=proxy_meshes(context.prepared),
        evidence=_evidence(context, state),
        covariance=None if people is None else people.alignment.covariance,
        traces=state.traces,
        warnings=tuple(dict.fromkeys(warnings)),
        path=capture.path if people is None else people.path,
    )


def label_inputs(room: Room) -> LabelInputs:
    """The people and the closed furniture of a finished room."""
    assert room.bodies is not None
    solid = tuple(
        standing_meshes(replace(piece, mesh=proxy))
        for piece, proxy in zip(room.scene.objects, room.proxies, strict=True)
    )
    ids = tuple(piece.id for piece in room.scene.objects)
    return LabelInputs(room.bodies, parts_of(room.bodies), solid, ids, room.scene.ground)


def _evidence(context: ReconstructionContext, state: SceneState) -> tuple[Evidence, ...]:
    """What held each object, and its energy by term at the final layout."""
    ids = context.prepared.objects.ids
    near = far = bodies = (0,) * len(ids)
    if state.cues is not None and state.contacts is not None:
        near, far, bodies = state.cues.near_pixels, state.cues.far_pixels, state.contacts.bodies
    near_body: Sequence[float | None] = [None] * len(ids)
    if state.cues is not None:
        samples = place(context.prepared.objects.samples, state.placed.layout)
        near_body = sample(state.cues.space.volume, samples).amin(-1).tolist()
    pixels = context.seen.masks.sum((-2, -1)).tolist()
    inputs, config = state.descent
    parts = energy_of(with_trees(inputs), config)(state.placed.layout[None]).parts
    terms = [{name: float(part[0, i]) for name, part in parts.items()} for i in range(len(ids))]
    energy = [sum(row.values()) for row in terms]
    rows = zip(ids, pixels, near, far, bodies, near_body, energy, terms, strict=True)
    return tuple(Evidence(*row) for row in rows)


# Whether a result can be true: a run that ends in what no room is says so and writes nothing.


LOWEST, HIGHEST = -30.0, -0.05  # [m] of a floor, below the camera
FARTHEST = 300.0  # [m] from the camera to anything of a room
APART = 1.0  # [m] between the given floor and that of the people, from which it is told


def check_floor(ground: float, capture: Capture) -> tuple[str, ...]:
    """Refuse a floor that no camera stands above; warn where a given one is elsewhere.

    Raises:
        InputError: If the floor is above the camera, or farther below it than in any room.
    """
    if not LOWEST <= ground <= HIGHEST:
        side = "above" if ground > 0 else "below"
        cause = "scene.json: 'ground.height'"
        if capture.bodies is not None:
            cause = "bodies.npz: the feet of the people"
        raise InputError(
            f"{cause} put the floor {abs(ground):.3g} m {side} the camera, expected"
            f" {-HIGHEST:g} to {-LOWEST:g} m below; are places in metres, and is z forward?"
        )
    given = capture.scene.ground
    if given is None or abs(given - ground) <= APART:
        return ()
    return (
        f"scene.json: field 'ground.height' has {given:.3g}, but people stand at {ground:.3g} m,"
        " which is taken",
    )


def check_room(room: Room) -> Room:
    """The room, if everything in it is finite and within reach.

    Raises:
        InputError: If an object or a body ended where nothing of a room is.
    """
    for piece in room.scene.objects:
        numbers = torch.cat([piece.t_world_object, piece.yaw[None], piece.scale])
        if not bool(numbers.isfinite().all()) or float(piece.t_world_object.norm()) > FARTHEST:
            where = [round(float(x), 2) for x in piece.t_world_object]
            raise InputError(
                f"{piece.id}: ended at {where} m, expected a place within {FARTHEST:g} m; is its"
                " place, its size or its mask wrong?"
            )
    if room.bodies is not None and not float(room.bodies.verts.abs().max()) <= FARTHEST:
        raise InputError(f"bodies.npz: bodies ended more than {FARTHEST:g} m away, expected nearer")
    return room


def warnings_of(capture: Capture) -> tuple[str, ...]:
    """What a run would tell of a capture besides its own warnings, before it places anything.

    Raises:
        InputError: What it would refuse.
    """
    from mover.pipeline.people import people_of
    from mover.pipeline.presets import ROBUST

    with tempfile.TemporaryDirectory() as folder:
        people = people_of(capture, ROBUST, Run(Path(folder)))
    if people is not None:
        return people.warnings
    ground = capture.scene.ground
    return () if ground is None else check_floor(ground, capture)
