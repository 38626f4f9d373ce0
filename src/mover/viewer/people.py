"""People on a time line."""

import threading
from dataclasses import dataclass, field
from typing import Any

import torch

from ..report_colours import person_colour
from ..report_thin import Thinning, thin_choice
from ..types import Bodies
from .drawing import bytes_of

FACES = 6000  # of a body, at most


@dataclass
class Cast:
    """The people of one world, ready to be drawn."""

    bodies: Bodies
    few: Thinning
    frames: list[int]
    rows: dict[tuple[int, int], int]
    """Row of each frame and person."""


def cast_of(bodies: Bodies | None) -> Cast | None:
    """Thin the bodies out; None: there is nobody."""
    if bodies is None or not len(bodies.verts):
        return None
    pairs = zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
    rows = {pair: row for row, pair in enumerate(pairs)}
    few = thin_choice(bodies.verts[len(bodies.verts) // 2], bodies.faces, FACES)
    return Cast(bodies, few, bodies.frame.unique().tolist(), rows)


@dataclass
class People:
    """The drawn people."""

    server: Any
    cast: Cast | None = None
    handles: dict[int, Any] = field(default_factory=lambda: {})
    visible: bool = True
    lock: threading.RLock = field(default_factory=threading.RLock)


def show_people(people: People, moment: int) -> None:
    """Draw the bodies of a moment, counted along the frames that have any."""
    with people.lock:
        cast = people.cast
        if cast is None:
            return
        frame = cast.frames[min(max(moment, 0), len(cast.frames) - 1)]
        for person in cast.bodies.person.unique().tolist():
            row = cast.rows.get((frame, person))
            if row is not None:
                _draw(people, cast, person, row)
            if person in people.handles:
                people.handles[person].visible = people.visible and row is not None


def replace_cast(people: People, cast: Cast | None) -> None:
    """Take other people, or the same in another world."""
    with people.lock:
        for handle in people.handles.values():
            handle.remove()
        people.handles, people.cast = {}, cast


def _draw(people: People, cast: Cast, person: int, row: int) -> None:
    verts = cast.bodies.verts[row, cast.few.kept].detach().to(torch.float32).numpy()
    if person in people.handles:
        people.handles[person].vertices = verts
        return
    people.handles[person] = people.server.scene.add_mesh_simple(
        f"/people/{person}", verts, cast.few.faces.numpy(),
        color=bytes_of(person_colour(person)), side="double",
    )  # fmt: skip
