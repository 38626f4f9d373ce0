"""Warn where the result is uncertain (supplement, "Failure Cases").

A seated person without a seat (a missing object), a lower body that is hidden (a guessed pose), and
a seat whose mesh has another height than its sitters (a wrong shape).
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool
from torch import Tensor

from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import postures
from mover.core.records import record, rows_of
from mover.core.types import STILL, Bodies, Camera, CameraPath, Layout, Objects, People
from mover.energy.human_terms import ContactPoints
from mover.geometry.camera import at_pixels, project, to_camera
from mover.geometry.path import from_reference, poses_at
from mover.geometry.placement import place
from mover.stages.masks import mask_table

OFTEN = 3  # bodies from which on something is worth a warning
SEEN = 0.25  # share of the lower body that must be seen
HEIGHT = 0.08  # [m], between a seat and its sitters
EVERY = 5  # of the bodies, checked for hidden legs
LEGS = ("left_sole", "right_sole", "seat", "left_thigh", "right_thigh")


@record
class DiagnosticInputs:
    """The finished room with its people."""

    bodies: Bodies
    parts: BodyParts
    people: People | None
    camera: Camera
    objects: Objects
    layout: Layout
    contacts: ContactPoints | None
    seated_on: Bool[Tensor, " bodies"]
    """Bodies whose seat is assigned to an object."""
    path: CameraPath = STILL
    """Of the cameras that saw the people, in the axes of `camera` [m]."""


def diagnostics(inputs: DiagnosticInputs) -> tuple[str, ...]:
    """Warnings, each one sentence."""
    return (*_nothing_below(inputs), *_hidden_legs(inputs), *_wrong_seats(inputs))


def _often(found: Bool[Tensor, " bodies"], bodies: Bodies) -> Iterator[tuple[int, int, str]]:
    """Each person of whom `OFTEN` bodies are found, how many they are, and in which frames."""
    for person in bodies.person.unique().tolist():
        frames = bodies.frame[found & (bodies.person == person)]
        if len(frames) >= OFTEN:
            yield person, len(frames), f"{int(frames.min())}-{int(frames.max())}"


def _nothing_below(inputs: DiagnosticInputs) -> Iterator[str]:
    floating = postures(inputs.bodies, inputs.parts).sitting & ~inputs.seated_on
    for person, count, frames in _often(floating, inputs.bodies):
        yield (
            f"person {person} sits on nothing in {count} bodies (frames {frames}): an object may be"
            " missing from the scene"
        )


def _hidden_legs(inputs: DiagnosticInputs) -> Iterator[str]:
    legs, bodies, camera = members(inputs.parts, *LEGS), inputs.bodies, inputs.camera
    if inputs.people is None or not bool(legs.any()):
        return
    table = mask_table(inputs.people, bodies)
    hidden = torch.zeros(len(bodies.frame), dtype=torch.bool)
    poses = poses_at(inputs.path, bodies.frame)
    for row in range(0, len(bodies.frame), EVERY):
        if table.own[row] is None:
            continue
        pose = rows_of(poses, torch.tensor([row]), "poses")
        there = to_camera(bodies.verts[row, legs], camera.R_cam_world)
        pixels = project(from_reference(there[None], pose)[0], camera.K).long()
        seen, _ = at_pixels(table.decode(row)[0], pixels)
        hidden[row] = seen.float().mean() < SEEN
    for person, count, frames in _often(hidden, bodies):
        yield (
            f"the lower body of person {person} is hidden in about {EVERY * count} bodies (frames"
            f" {frames}): its pose there is a guess"
        )


def _wrong_seats(inputs: DiagnosticInputs) -> Iterator[str]:
    contacts, objects = inputs.contacts, inputs.objects
    if contacts is None:
        return
    tops = place(objects.top, inputs.layout)
    for k, i in enumerate(contacts.object_of.tolist()):
        points = contacts.points[k, 0][contacts.weight[k, 0] > 0]
        if not bool(objects.is_seat[i]) or int(contacts.bodies[k]) < OFTEN or not len(points):
            continue
        below = torch.cdist(points[:, [0, 2]], tops[i][:, [0, 2]]).argmin(-1)
        gap = float((points[:, 1] - tops[i][below, 1]).median())  # over the seat below them [m]
        if abs(gap) > HEIGHT:
            side = "above" if gap > 0 else "below"
            yield (
                f"{objects.ids[i]}: its sitters touch {100 * abs(gap):.0f} cm {side} its seat: the"
                " mesh may have the wrong shape"
            )
