"""Explanations as JSON: short ones beside each object of scene.json, whole ones in run.json."""

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from .explanation import LEVEL
from .explanation_records import UNKNOWNS, Explanation, Facts, Pull
from .geometry.rotations import wrap

DIGITS = 6


def scene_fields(explanations: Sequence[Explanation]) -> dict[str, dict[str, Any]]:
    """Fields `explanation` and `uncertainty` of each object, by its id (docs/data.md)."""
    return {
        e.facts.id: {
            "explanation": {"verdict": e.verdict, "evidence": list(e.sentences)},
            "uncertainty": _uncertainty(e),
        }
        for e in explanations
    }


def _uncertainty(explanation: Explanation) -> dict[str, Any]:
    place = explanation.facts.place
    ranges: dict[str, list[float]] = {}
    for k, r in enumerate(explanation.ranges):
        low, high = r.low, r.high
        if k > 3:  # sizes as factors of the size that the result has
            low, high = (math.exp(v - float(place[k])) for v in (low, high))
        ranges[_key(k)] = [_short(low), _short(high)]
    return {
        "level": LEVEL,
        "calibrated": explanation.calibrated,
        "base": _row(place[:3]),
        "ranges": ranges,
        "covariance": [_row(row) for row in explanation.covariance],
        "alternatives": [
            {
                "probability": _short(o.probability),
                "base": _row(o.place[:3]),
                "yaw": _short(float(wrap(o.place[3]))),
            }
            for o in explanation.others
        ],
    }


def log_rows(explanations: Sequence[Explanation]) -> list[dict[str, Any]]:
    """All that is known, one row an object, for run.json."""
    return [
        {
            "id": e.facts.id,
            "verdict": e.verdict,
            "evidence": list(e.sentences),
            "uncertainty": _uncertainty(e),
            "energy": _short(e.facts.energy),
            "pulls": [_pull(p) for p in e.facts.pulls],
            **_evidence(e.facts),
        }
        for e in explanations
    ]


def _pull(pull: Pull) -> dict[str, Any]:
    return {
        "term": pull.term,
        "energy": _short(pull.energy),
        "share": _short(pull.share),
        "tells_distance": _short(pull.tells),
        "force": _named(pull.force),
        "move_without": _named(pull.move),
    }


def _evidence(facts: Facts) -> dict[str, Any]:
    passing = facts.passing
    return {
        "bounds": [
            {"side": b.side, "depth": _short(b.depth), "room": _short(b.slack), "frame": b.frame,
             "person": b.person, "pixels": b.pixels}
            for b in facts.bounds
        ],
        "touches": [
            {"part": t.part, "hand": t.hand, "person": t.person, "frames": list(t.frames),
             "bodies": t.bodies, "gap": _short(t.gap)}
            for t in facts.touches
        ],
        "nearest_body": None if passing is None else {
            "distance": _short(passing.distance), "frame": passing.frame,
            "person": passing.person, "side": passing.side,
        },
        "silhouette_iou": None if facts.overlap is None else _short(facts.overlap),
        "hidden_sides": list(facts.hidden_sides),
        "pinned": facts.pinned,
    }  # fmt: skip


def _named(row: Tensor) -> dict[str, float]:
    return {_key(k): _short(v) for k, v in enumerate(row.tolist())}


def _key(index: int) -> str:
    """`x`, `y`, `z`, `yaw`, and the sizes along the axes of the mesh."""
    return UNKNOWNS[index] if index < 4 else f"size_{'xyz'[index - 4]}"


def _row(values: Tensor) -> list[float]:
    return [_short(v) for v in values.tolist()]


def _short(value: float) -> float:
    return round(value, DIGITS)
