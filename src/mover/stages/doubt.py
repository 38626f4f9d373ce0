"""Say where the result should be doubted (supplement, "Failure Cases").

A person who sits on nothing (a missing object), a lower body that is hidden (a guessed pose), and a
seat whose mesh has another height than its sitters (a wrong shape).
"""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..bodies.parts import PARTS, Parts
from ..bodies.touch import postures
from ..geometry.camera import project, to_camera
from ..geometry.placement import place
from ..records import record
from ..terms.contact import Touches
from ..types import Bodies, Camera, Layout, Objects, People
from .person_masks import mask_table

OFTEN = 3  # bodies from which on a doubt is worth a warning
SEEN = 0.25  # share of the lower body that must be seen
HEIGHT = 0.08  # [m], between a seat and its sitters
EVERY = 5  # of the bodies, checked for hidden legs


@record
class DoubtInputs:
    """The finished room with its people."""

    bodies: Bodies
    parts: Parts
    people: People | None
    camera: Camera
    objects: Objects
    layout: Layout
    touches: Touches | None
    seated_on: Bool[Tensor, " bodies"]
    """Bodies whose seat is assigned to an object."""


def doubts(inputs: DoubtInputs) -> tuple[str, ...]:
    """Warnings, each one sentence."""
    return (*_nothing_below(inputs), *_hidden_legs(inputs), *_wrong_seats(inputs))


def _runs(frames: Tensor) -> str:
    return f"{int(frames.min())}-{int(frames.max())}"


def _nothing_below(inputs: DoubtInputs) -> Iterator[str]:
    bodies = inputs.bodies
    sits = postures(bodies, inputs.parts).sitting
    floating = sits & ~inputs.seated_on
    for person in bodies.person.unique().tolist():
        mine = floating & (bodies.person == person)
        if int(mine.sum()) >= OFTEN:
            yield (
                f"person {person} sits on nothing in {int(mine.sum())} bodies (frames"
                f" {_runs(bodies.frame[mine])}): an object may be missing from the scene"
            )


def _hidden_legs(inputs: DoubtInputs) -> Iterator[str]:
    if inputs.people is None:
        return
    table, bodies = mask_table(inputs.people, inputs.bodies), inputs.bodies
    names = ("left_sole", "right_sole", "seat", "left_thigh", "right_thigh")
    legs = torch.isin(inputs.parts.part_of, torch.tensor([PARTS.index(n) for n in names]))
    hidden = torch.zeros(len(bodies.frame), dtype=torch.bool)
    if not bool(legs.any()):
        return
    for row in range(0, len(bodies.frame), EVERY):
        if table.own[row] is None:
            continue
        seen, _ = table.decode(row)
        pixels = project(
            to_camera(bodies.verts[row, legs], inputs.camera.R_cam_world), inputs.camera.K
        ).long()
        x, y = pixels[:, 0].clamp(0, seen.shape[1] - 1), pixels[:, 1].clamp(0, seen.shape[0] - 1)
        hidden[row] = seen[y, x].float().mean() < SEEN
    for person in bodies.person.unique().tolist():
        mine = hidden & (bodies.person == person)
        if int(mine.sum()) >= OFTEN:
            yield (
                f"the lower body of person {person} is hidden in about {EVERY * int(mine.sum())}"
                f" bodies (frames {_runs(bodies.frame[mine])}): its pose there is a guess"
            )


def _wrong_seats(inputs: DoubtInputs) -> Iterator[str]:
    touches = inputs.touches
    if touches is None:
        return
    tops = place(inputs.objects.top, inputs.layout)
    for k, i in enumerate(touches.object_of.tolist()):
        weight = touches.weight[k, 0]
        if not bool(inputs.objects.is_seat[i]) or int(touches.bodies[k]) < OFTEN:
            continue
        gap = _gap(touches.points[k, 0], weight, tops[i])
        if abs(gap) > HEIGHT:
            side = "above" if gap > 0 else "below"
            yield (
                f"{inputs.objects.ids[i]}: its sitters touch {100 * abs(gap):.0f} cm {side} its"
                " seat: the mesh may have the wrong shape"
            )


def _gap(
    points: Float[Tensor, "points 3"],
    weight: Float[Tensor, " points"],
    seat: Float[Tensor, "region 3"],
) -> float:
    """Median height of contact points over the seat below them [m]."""
    real = points[weight > 0]
    if len(real) == 0:
        return 0.0
    below = torch.cdist(real[:, [0, 2]], seat[:, [0, 2]]).argmin(-1)
    return float((real[:, 1] - seat[below, 1]).median())
