"""Whether moved objects stand where they should when, and move when they should."""

from dataclasses import asdict, dataclass
from typing import Any

from mover.core.types import Scene
from mover.evaluate.scene import Pair, iou3d
from mover.geometry.placement import changes, placed_at

SOON = 5  # frames after a true change, by which a video of any rate shows the object at rest


@dataclass(frozen=True)
class MovedMetrics:
    """An object that is truly moved, and what was found of it."""

    id: str
    iou3d: list[float]
    """In each true stay."""
    late: list[float | None]
    """How far the nearest beginning or end of a move is from each true one [s]; None: none is."""
    on_the_way: float | None
    """Mean IoU3D over the frames in which it truly moves with somebody; None: there are none."""


def measure_moves(truth: Scene, found: Scene, fps: float | None = None) -> dict[str, Any]:
    """The `objects` that are truly moved, and of how many others this is said by mistake.

    Args:
        truth: The true scene.
        found: The scene that is judged.
        fps: Frames a second; None: errors of times are in frames.
    """
    pieces = {piece.id: piece for piece in found.objects}
    rows: list[dict[str, Any]] = []
    for true in truth.objects:
        piece = pieces.get(true.id)
        if not true.segments or piece is None:
            continue
        stays = [segment.frame + SOON for segment in true.segments if segment.mover is None]
        held = [segment.frame for segment in true.segments if segment.mover is not None]
        shared = {
            frame: iou3d(Pair(
                placed_at(piece, frame), found.camera, placed_at(true, frame), truth.camera, 1
            ))
            for frame in (*stays, *held)
        }  # fmt: skip
        on_the_way = sum(shared[frame] for frame in held) / len(held) if held else None
        late = [
            min((abs(change - when) / (fps or 1.0) for change in changes(piece)), default=None)
            for when in changes(true)
        ]
        rows.append(
            asdict(MovedMetrics(true.id, [shared[frame] for frame in stays], late, on_the_way))
        )
    still = {true.id for true in truth.objects if not true.segments}
    false = sum(bool(piece.segments) for name, piece in pieces.items() if name in still)
    return {"objects": rows, "false": false}
