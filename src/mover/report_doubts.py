"""The report's section on why each object stands where it stands."""

import math
from collections.abc import Sequence
from html import escape

import torch

from .explanation import LEVEL
from .explanation_records import UNKNOWNS, Explanation, Pull
from .report_colours import colour, css

LIKELY = math.sqrt(-2 * math.log(1 - LEVEL))  # radius of the ellipse that holds 90 % in the plane


def draw_doubts(explanations: Sequence[Explanation]) -> str:
    """Ellipses on the plan: 90 % of where each object stands, dots where else it may stand."""
    return "".join(_ellipse(e, css(colour(i))) for i, e in enumerate(explanations))


def _ellipse(explanation: Explanation, tint: str) -> str:
    flat = explanation.covariance[[0, 2]][:, [0, 2]].double()
    values, axes = torch.linalg.eigh(flat)
    small, large = (LIKELY * values.clamp_min(0).sqrt()).tolist()
    turn = math.degrees(math.atan2(float(axes[1, 1]), float(axes[0, 1])))
    x, z = explanation.facts.place[[0, 2]].tolist()
    others = "".join(
        f"M{float(o.place[0]):.3f} {float(o.place[2]):.3f}h0" for o in explanation.others
    )
    dots = f'<path class="other" style="--tint:{tint}" d="{others}"/>' if others else ""
    return (
        f'<ellipse class="doubt" style="--tint:{tint}" cx="{x:.3f}" cy="{z:.3f}" rx="{large:.3f}" '
        f'ry="{small:.3f}" transform="rotate({turn:.1f} {x:.3f} {z:.3f})"/>{dots}'
    )


def doubts_list(explanations: Sequence[Explanation]) -> str:
    """Each object with its verdict, its evidence in sentences, and a table of what pulls at it."""
    if not explanations:
        return ""
    note = ""
    if not all(e.calibrated for e in explanations):
        note = '<p class="hint">Doubts are not calibrated for these settings.</p>'
    items = "".join(_object(e, css(colour(i))) for i, e in enumerate(explanations))
    return f'<div class="reasons">{items}</div>{note}'


def _object(explanation: Explanation, tint: str) -> str:
    sentences = "".join(f"<li>{escape(s)}</li>" for s in explanation.sentences)
    dot = f'<span class="dot" style="--tint:{tint}"></span>'
    return (
        f"<details><summary>{dot}<b>{escape(explanation.facts.id)}</b> "
        f"{escape(explanation.verdict)}</summary><ul>{sentences}</ul>"
        f"{_ranges(explanation)}{_pulls(explanation.facts.pulls)}</details>"
    )


def _ranges(explanation: Explanation) -> str:
    """Half widths of the 90 % ranges in one line."""
    half = [(r.high - r.low) / 2 for r in explanation.ranges]
    parts = [f"{name} ±{100 * half[k]:.1f} cm" for k, name in ((0, "x"), (2, "z"))]
    parts.append(f"yaw ±{math.degrees(half[3]):.1f}°")
    parts += [f"{UNKNOWNS[k]} ±{100 * math.expm1(half[k]):.1f} %" for k in (4, 5, 6)]
    return f'<p class="hint">{LEVEL:.0%} of the probability: {", ".join(parts)}</p>'


def _pulls(pulls: Sequence[Pull]) -> str:
    head = (
        '<tr><th class="text">Term</th><th>Energy</th><th>Share</th><th>Tells distance</th>'
        "<th>Force x, z [1/m]</th><th>Turn [1/rad]</th><th>Without it</th></tr>"
    )
    rows = "".join(_pull(p) for p in pulls if p.energy or bool(p.force.any()))
    table = f"<table><thead>{head}</thead><tbody>{rows}</tbody></table>"
    return f'<div class="wide">{table}</div>' if rows else ""


def _pull(pull: Pull) -> str:
    force, move = pull.force.tolist(), pull.move.tolist()
    away = 100 * math.hypot(move[0], move[2])
    cells = (
        f"{pull.energy:.4f}", f"{100 * pull.share:.0f} %", f"{100 * pull.tells:.0f} %",
        f"{_plain(force[0], 3)}, {_plain(force[2], 3)}", _plain(force[3], 3),
        f"{away:.1f} cm, {_plain(math.degrees(move[3]), 1)}°",
    )  # fmt: skip
    body = "".join(f"<td>{c}</td>" for c in cells)
    return f'<tr><th class="text">{escape(pull.term.replace("_", " "))}</th>{body}</tr>'


def _plain(value: float, digits: int) -> str:
    """Without a minus before zero."""
    return f"{round(value, digits) + 0.0:.{digits}f}"
