"""The report's section on why each object stands where it stands."""

import math
from collections.abc import Sequence

import torch

from mover.app.report.tables import Cell, draw_table
from mover.app.report.templates import fill
from mover.core.colours import colour, css
from mover.core.explanation import UNKNOWNS, Explanation, Pull
from mover.evaluate.explanation import LEVEL

LIKELY = math.sqrt(-2 * math.log(1 - LEVEL))  # radius of the ellipse that holds 90 % in the plane


def draw_uncertainty(explanations: Sequence[Explanation]) -> str:
    """Ellipses on the plan: 90 % of where each object stands, dots where else it may stand."""
    ellipses = [_ellipse(e, css(colour(i))) for i, e in enumerate(explanations)]
    return fill("uncertainty.svg", ellipses=ellipses)


def _ellipse(explanation: Explanation, tint: str) -> dict[str, str]:
    flat = explanation.covariance[[0, 2]][:, [0, 2]].double()
    values, axes = torch.linalg.eigh(flat)
    small, large = (LIKELY * values.clamp_min(0).sqrt()).tolist()
    turn = math.degrees(math.atan2(float(axes[1, 1]), float(axes[0, 1])))
    x, z = explanation.facts.place[[0, 2]].tolist()
    places = [other.place.tolist() for other in explanation.others]
    numbers = {"x": x, "z": z, "large": large, "small": small}
    return {
        "tint": tint,
        **{name: f"{value:.3f}" for name, value in numbers.items()},
        "turn": f"{turn:.1f}",
        "others": "".join(f"M{place[0]:.3f} {place[2]:.3f}h0" for place in places),
    }


def explanations_list(explanations: Sequence[Explanation]) -> str:
    """Each object with its verdict, its evidence in sentences, and a table of what pulls at it."""
    if not explanations:
        return ""
    rows = [
        {
            "tint": css(colour(index)),
            "explanation": explanation,
            "ranges": _ranges(explanation),
            "pulls": _pulls(explanation.facts.pulls),
        }
        for index, explanation in enumerate(explanations)
    ]
    calibrated = all(e.calibrated for e in explanations)
    return fill("explanations.html", rows=rows, calibrated=calibrated)


def _ranges(explanation: Explanation) -> str:
    """Half widths of the 90 % ranges in one line."""
    half = [(r.high - r.low) / 2 for r in explanation.ranges]
    parts = [f"{name} ±{100 * half[k]:.1f} cm" for k, name in ((0, "x"), (2, "z"))]
    parts.append(f"yaw ±{math.degrees(half[3]):.1f}°")
    parts += [f"{UNKNOWNS[k]} ±{100 * math.expm1(half[k]):.1f} %" for k in (4, 5, 6)]
    return f"{LEVEL:.0%} of the probability: {', '.join(parts)}"


def _pulls(pulls: Sequence[Pull]) -> str:
    titles = ("Energy", "Share", "Tells distance", "Force x, z [1/m]", "Turn [1/rad]", "Without it")
    rows = [_pull(p) for p in pulls if p.energy or bool(p.force.any())]
    return draw_table([Cell("Term", "text"), *map(Cell, titles)], rows)


def _pull(pull: Pull) -> list[Cell]:
    force, move = pull.force.tolist(), pull.move.tolist()
    away = 100 * math.hypot(move[0], move[2])
    cells = (
        f"{pull.energy:.4f}", f"{100 * pull.share:.0f} %", f"{100 * pull.constrains:.0f} %",
        f"{_plain(force[0], 3)}, {_plain(force[2], 3)}", _plain(force[3], 3),
        f"{away:.1f} cm, {_plain(math.degrees(move[3]), 1)}°",
    )  # fmt: skip
    return [Cell(pull.term.replace("_", " "), "text"), *map(Cell, cells)]


def _plain(value: float, digits: int) -> str:
    """Without a minus before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
