"""Whether the furniture of a rebuilt room stays under gravity, before and after, and nudged."""

import statistics
from collections.abc import Sequence
from typing import Any

from mover.app.results import labels_of
from mover.app.simulate import nudged, ranges_in
from mover.core.run import Run
from mover.core.types import Room, Scene
from mover.evaluate.explanation import scene_fields
from mover.evaluate.stability import SimulatedObject, loads_in, simulate


def measure_stability(truth: Scene, room: Room, run: Run) -> dict[str, Any]:
    """Let gravity act on the initial scene, the result, the result nudged, and the truth.

    Who sits in the result sits on the same place of each piece in all of them.
    """
    people = room.bodies
    loads = () if people is None else loads_in(labels_of(room, run), room.scene, people.fps)
    ranges = ranges_in(scene_fields(room.explanations))
    steady, _, nudges = nudged(room.scene, run, ranges, None, loads)
    scenes = {"initial": room.initial, "image": room.image_only, "full": room.scene,
              "nudged": steady, "truth": truth}  # fmt: skip
    found = {name: simulate(scene, run, None, loads) for name, scene in scenes.items()}
    said = {nudge.id: nudge.reason or "nudged" for nudge in nudges}
    objects = [
        {"id": row.id, "category": row.category}
        | {name: _values(rows[place]) for name, rows in found.items() if name != "truth"}
        | {"full": _values(row) | {"nudge": said.get(row.id, "")}}
        for place, row in enumerate(found["full"])
        if not row.fixed
    ]
    means = {name: _means(rows) for name, rows in found.items()}
    return {**means, "objects": objects, "warnings": list(room.warnings)}


def _values(row: SimulatedObject) -> dict[str, float]:
    """One piece, under who sits on it where that is worse."""
    return {
        "stands": float(row.stays),
        "toppled": float(row.toppled),
        "moved": max(row.moved, row.moved_loaded),
        "turned": max(row.turned, row.turned_loaded),
        "stuck": row.stuck,
        "load": row.load,
    }


def _means(rows: Sequence[SimulatedObject]) -> dict[str, float]:
    """Of the pieces of a scene that could move."""
    loose = [_values(row) for row in rows if not row.fixed]
    return {name: statistics.fmean(v[name] for v in loose) for name in loose[0]} if loose else {}
