"""Who is who: the true objects, and what stands for them before and after (docs/metrics.md)."""

from .metrics_scene import match
from .types import Piece, Scene


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
