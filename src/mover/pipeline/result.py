"""The room that the pipeline returns, and whether it can be true."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mover.bodies.parts import parts_of
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Capture, Evidence, Room, Scene
from mover.geometry.placement import place, standing_meshes
from mover.geometry.volume import sample
from mover.io.capture.pose_file import into_camera
from mover.pipeline.estimates import lens_and_scale, odd_sizes, odd_statures, tilt_of_camera
from mover.pipeline.objects import Arrangement, Humans, Setup
from mover.pipeline.people import Located, check_floor, estimate_people
from mover.pipeline.presets import ROBUST
from mover.stages.contacts.diagnostics import DiagnosticInputs, diagnostics
from mover.stages.contacts.label_contacts import LabelInputs
from mover.stages.objects.place_objects import energy_of
from mover.stages.objects.prepare_objects import proxy_meshes, to_objects
from mover.stages.objects.seat_heights import seat_warnings

FARTHEST = 300.0  # [m] from the camera to anything of a room


def to_world(bodies: Bodies, camera: Camera) -> Bodies:
    """Bodies in the world, parameters included."""
    turned = into_camera(replace(bodies, space="world"), camera.R_cam_world.mT)
    return replace(turned, space="world")


def unfurnished(capture: Capture, people: Located | None) -> Room:
    """A room without objects still has a camera, a floor and people."""
    found = None if people is None else people.alignment
    camera = capture.scene.camera if found is None else found.camera
    ground = capture.scene.ground if found is None else found.ground
    scene = Scene(camera, ground, ())
    warnings = capture.warnings
    if people is not None:
        warnings += (*people.warnings, *_odd_people(people, camera))
    bodies = None if people is None else to_world(people.bodies, camera)
    return _room(
        capture, people, scene=scene, image_only=scene, bodies=bodies, proxies=(), evidence=(),
        traces={}, warnings=warnings,
    )  # fmt: skip


def _room(capture: Capture, people: Located | None, scene: Scene, **found: Any) -> Room:  # noqa: ANN401
    """What was found, with what the people and the capture say of the whole room."""
    return Room(
        scene=scene, initial=capture.scene, kept=None if people is None else people.kept,
        covariance=None if people is None else people.alignment.covariance,
        path=capture.path if people is None else people.path,
        estimates=_estimates(capture, scene.camera, people), **found,
    )  # fmt: skip


def furnished(
    setup: Setup, placed: Arrangement, people: Located | None, humans: Humans | None
) -> Room:
    """The room with the user's own meshes where the proxies ended, its people and warnings."""
    capture, prepared, camera = setup.capture, setup.prepared, placed.camera
    objects = to_objects(capture.scene.objects, prepared, placed.layout)
    by_image = to_objects(capture.scene.objects, prepared, placed.by_image)
    warnings = [*capture.warnings, *prepared.warnings, *seat_warnings(objects)]
    warnings += odd_sizes(objects)
    bodies = None
    if people is not None:
        bodies = to_world(people.bodies, camera)
        warnings += (*people.warnings, *_odd_people(people, camera))
        if humans is not None:
            warnings += diagnostics(DiagnosticInputs(
                rows_of(bodies, people.kept), people.parts, capture.people, camera,
                prepared.objects, placed.layout, humans.contacts.points,
                humans.contacts.seated_on, people.path,
            ))  # fmt: skip
    return _room(
        capture, people, scene=Scene(camera, placed.ground, objects), bodies=bodies,
        image_only=Scene(camera, placed.ground, by_image), proxies=proxy_meshes(prepared),
        evidence=_evidence(setup, placed, humans), traces=placed.traces,
        warnings=tuple(dict.fromkeys(warnings)),
    )  # fmt: skip


def _estimates(capture: Capture, camera: Camera, people: Located | None) -> tuple[str, ...]:
    size = None if people is None else people.size
    if people is not None and capture.camera_height is not None:
        size = 0.0
    found = lens_and_scale(camera, capture.focal_spread, size)
    if people is None:
        return found
    spread = float(people.alignment.covariance.diag()[:2].amax()) ** 0.5
    return (*found, tilt_of_camera(camera, spread))


def _odd_people(people: Located, camera: Camera) -> tuple[str, ...]:
    return odd_statures(people.in_world(camera), people.parts)


def _evidence(setup: Setup, placed: Arrangement, humans: Humans | None) -> tuple[Evidence, ...]:
    """What held each object, and its energy by term at the final layout."""
    ids = setup.objects.ids
    near = far = bodies = (0,) * len(ids)
    near_body: Sequence[float | None] = [None] * len(ids)
    if humans is not None:
        cues, bodies = humans.cues, humans.contacts.bodies
        near, far = cues.near_pixels, cues.far_pixels
        samples = place(setup.objects.samples, placed.layout)
        near_body = sample(cues.space.volume, samples).amin(-1).tolist()
    pixels = setup.seen.masks.sum((-2, -1)).tolist()
    parts = energy_of(placed.minimised, placed.config)(placed.layout[None]).parts
    terms = [{name: float(part[0, i]) for name, part in parts.items()} for i in range(len(ids))]
    energy = [sum(row.values()) for row in terms]
    rows = zip(ids, pixels, near, far, bodies, near_body, energy, terms, strict=True)
    return tuple(Evidence(*row) for row in rows)


def label_inputs(room: Room) -> LabelInputs:
    """The people and the closed furniture of a finished room."""
    assert room.bodies is not None
    solid = tuple(
        standing_meshes(replace(piece, mesh=proxy))
        for piece, proxy in zip(room.scene.objects, room.proxies, strict=True)
    )
    ids = tuple(piece.id for piece in room.scene.objects)
    return LabelInputs(room.bodies, parts_of(room.bodies), solid, ids, room.scene.ground)


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


def warnings_of(capture: Capture) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What a run would warn of besides the capture's own warnings, before it places anything.

    Returns:
        Warnings, and lens, scale and tilt with their spreads (`Room.estimates`).

    Raises:
        InputError: What it would refuse.
    """
    with tempfile.TemporaryDirectory() as folder:
        people = estimate_people(capture, ROBUST, Run(Path(folder)))
    ground, camera = capture.scene.ground, capture.scene.camera
    warnings = odd_sizes(capture.scene.objects)
    if people is not None:
        camera = people.alignment.camera
        warnings += (*people.warnings, *_odd_people(people, camera))
    elif ground is not None:
        warnings += check_floor(ground, capture)
    return warnings, _estimates(capture, camera, people)
