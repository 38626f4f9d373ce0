"""Who is who: the true objects, and what stands for them before and after (docs/metrics.md)."""

from collections.abc import Sequence
from typing import Any

from .metrics_scene import OBJECT_METRICS, Pair, match, measure, measure_missing
from .types import Piece, Scene

SIDES = ("initial", "result")


def pairs(
    initial: Scene, result: Scene, truth: Scene, by_place: bool = True
) -> tuple[dict[str, Piece], dict[str, Piece]]:
    """Initial objects and those of the result by true id; settled on the initial scene."""
    same = {piece.id: piece.id for piece in truth.pieces}
    before = match(initial, truth, same, by_place)
    known = same | {name: piece.id for name, piece in before.items()}
    return before, match(result, truth, known, by_place)


def unmatched(
    initial: Scene, result: Scene, truth: Scene, by_place: bool = True
) -> dict[str, list[str]]:
    """Ids of true objects that the result lacks, and of its objects that stand for no true one.

    Returns:
        `missed`, which count as IoU 0 in the means, and `false`, which are in no mean.
    """
    found = pairs(initial, result, truth, by_place)[1]
    partners = {piece.id for piece in found.values()}
    return {
        "missed": [piece.id for piece in truth.pieces if piece.id not in found],
        "false": [piece.id for piece in result.pieces if piece.id not in partners],
    }


def measure_objects(
    scenes: tuple[Scene, Scene, Scene], sides: Sequence[str], samples: int, by_place: bool
) -> list[dict[str, Any]]:
    """Each true object in the initial scene and in the result, as far as they are asked for.

    Args:
        scenes: The initial one, the result and the truth.
        sides: Some of `SIDES`.
        samples: Points on each true surface.
        by_place: Whether objects that bear no true name are paired by place.
    """
    initial, result, truth = scenes
    found: dict[str, dict[str, Piece]] = dict(
        zip(SIDES, pairs(initial, result, truth, by_place), strict=True)
    )
    there: dict[str, Scene] = dict(zip(SIDES, (initial, result), strict=True))

    def of(side: str, true: Piece) -> dict[str, float]:
        piece = found[side].get(true.id)
        if piece is None:
            return measure_missing(true, truth.camera)
        pair = Pair(piece, there[side].camera, true, truth.camera, samples)
        return measure(OBJECT_METRICS, pair)

    return [{"id": true.id} | {side: of(side, true) for side in sides} for true in truth.pieces]


def means_of(objects: Sequence[dict[str, Any]], side: str) -> dict[str, float]:
    """Means over those objects that have the metric."""
    values = {n: [item[side][n] for item in objects if n in item[side]] for n in OBJECT_METRICS}
    return {name: sum(found) / len(found) for name, found in values.items() if found}
