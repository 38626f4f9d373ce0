"""The report's numbers as HTML: objects, metrics, stages, warnings and settings."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import torch

from .geometry.camera import to_camera
from .geometry.placement import place_piece
from .geometry.rotations import wrap
from .report_colours import colour, css
from .types import Piece, Scene

NOTHING = "–"


@dataclass(frozen=True)
class Quantity:
    """How a number of metrics.json is written."""

    label: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 3
    more_is_better: bool = False


_CM, _DEG, _PERCENT = ("cm", 100.0, 1), ("°", 180 / math.pi, 2), ("%", 100.0, 1)
QUANTITIES = {
    "iou3d": Quantity("3D overlap with the truth (IoU)", more_is_better=True),
    "iou2d": Quantity("Overlap of the image boxes (IoU)", more_is_better=True),
    "p2s": Quantity("True surface to estimated surface", *_CM),
    "center_error": Quantity("Error of the centre", *_CM),
    "yaw_error": Quantity("Error of the orientation", *_DEG),
    "size_error": Quantity("Error of the size", *_CM),
    "contact": Quantity("Contacts that touch furniture", *_PERCENT, True),
    "contact_f1": Quantity("Contact F1", more_is_better=True),
    "non_collision": Quantity("Body outside furniture", *_PERCENT, True),
    "penetration_depth": Quantity("Depth of bodies in furniture", *_CM),
    "pitch_error": Quantity("Error of the camera's pitch", *_DEG),
    "roll_error": Quantity("Error of the camera's roll", *_DEG),
    "ground_error": Quantity("Error of the floor's height", *_CM),
    "ground_penetration_frequency": Quantity("Frames with soles under the floor", *_PERCENT),
    "ground_penetration_distance": Quantity("Depth of soles under the floor", *_CM),
    "pje": Quantity("Error of the joints", *_CM),
    "v2v": Quantity("Error of the body's surface", *_CM),
    "p_pje": Quantity("Error of the joints, aligned", *_CM),
    "p_v2v": Quantity("Error of the body's surface, aligned", *_CM),
}


@dataclass(frozen=True)
class Change:
    """What the run did to an object."""

    moved: float
    """Distance between the centres of its box, seen from the camera [m]."""
    turned: float
    """Turn about its own vertical [rad]."""
    grown: tuple[float, ...]
    """Factor of its size along each of its axes."""


def find_changes(initial: Scene, result: Scene) -> dict[str, Change]:
    """What happened to each object that both scenes hold."""
    old = {piece.id: piece for piece in initial.pieces}
    return {
        piece.id: Change(
            float((_centre(piece, result) - _centre(old[piece.id], initial)).norm()),
            float(wrap(piece.yaw - old[piece.id].yaw)),
            tuple((piece.scale / old[piece.id].scale).tolist()),
        )
        for piece in result.pieces
        if piece.id in old
    }


def _centre(piece: Piece, scene: Scene) -> torch.Tensor:
    verts = place_piece(piece).verts[piece.mesh.faces.unique()]
    return to_camera((verts.amin(0) + verts.amax(0)) / 2, scene.camera.R_cam_world)


def write_quantity(key: str, value: float | None, unit: bool = True) -> str:
    """A number of metrics.json with its unit."""
    quantity = QUANTITIES.get(key, Quantity(key))
    if value is None or not math.isfinite(value):
        return NOTHING
    text = f"{quantity.factor * value:.{quantity.digits}f}"
    if not unit or not quantity.unit:
        return text
    return text + ("" if quantity.unit == "°" else "\N{NO-BREAK SPACE}") + quantity.unit


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Each metric before and after, coloured by whether it became better."""
    before, after = metrics.get("initial") or {}, metrics.get("result") or {}
    keys = [k for k in QUANTITIES if k in before or k in after]
    keys += [
        k
        for k in (*before, *after)
        if k not in QUANTITIES and _is_number(before.get(k, after.get(k)))
    ]
    rows = [_metric_row(k, before.get(k), after.get(k)) for k in dict.fromkeys(keys)]
    head = '<tr><th class="text">Metric</th><th>Before</th><th>After</th><th>Change</th></tr>'
    return _table(head, rows) if rows else ""


def _metric_row(key: str, before: float | None, after: float | None) -> str:
    quantity = QUANTITIES.get(key, Quantity(key))
    change, mood = NOTHING, ""
    if before is not None and after is not None and math.isfinite(before) and math.isfinite(after):
        grown = quantity.factor * (after - before)
        change = f"{grown:+.{quantity.digits}f}".replace("-", "−")
        if key in QUANTITIES and float(f"{grown:.{quantity.digits}f}"):
            mood = "better" if (grown > 0) == quantity.more_is_better else "worse"
    return (
        f"<tr><th>{escape(quantity.label)}</th><td>{write_quantity(key, before)}</td>"
        f'<td>{write_quantity(key, after)}</td><td class="{mood}">{change}</td></tr>'
    )


def objects_table(
    initial: Scene,
    result: Scene,
    rows: Sequence[Mapping[str, Any]],
    metrics: Mapping[str, Any] | None,
) -> str:
    """What happened to each object, and the evidence and numbers that `rows` give for it."""
    changes = find_changes(initial, result)
    extra = {str(row.get("id")): row for row in rows}
    fields = list(dict.fromkeys(k for row in rows for k in row if k not in ("id", "category")))
    scores = {str(o.get("id")): o for o in (metrics or {}).get("objects") or ()}
    judged = [
        k
        for k in ("iou3d", "center_error")
        if any(k in (o.get("result") or {}) for o in scores.values())
    ]
    titles = [
        "Moved",
        "Turned",
        "Size",
        *(QUANTITIES[k].label for k in judged),
        *(f.replace("_", " ") for f in fields),
    ]
    head = f'<tr><th>Object</th><th class="text">Category</th>{"".join(f"<th>{escape(t)}</th>" for t in titles)}</tr>'
    lines: list[str] = []
    for index, piece in enumerate(result.pieces):
        cells = [
            *_change_cells(changes.get(piece.id)),
            *(_score_cell(scores.get(piece.id), k) for k in judged),
        ]
        cells += [write_value(extra.get(piece.id, {}).get(f)) for f in fields]
        lines.append(
            f'<tr><th><span class="dot" style="--tint:{css(colour(index))}"></span>{escape(piece.id)}</th>'
            f'<td class="text">{escape(piece.category)}</td>{"".join(f"<td>{c}</td>" for c in cells)}</tr>'
        )
    return _table(head, lines) if lines else ""


def _change_cells(change: Change | None) -> tuple[str, str, str]:
    if change is None:
        return ("new", NOTHING, NOTHING)
    grown = [f"{100 * (g - 1):+.0f}".replace("-", "−") for g in change.grown]
    size = f"{grown[0]} %" if len(set(grown)) == 1 else f"{' / '.join(grown)} %"
    turned = f"{math.degrees(change.turned):+.1f}°".replace("-", "−")
    return (f"{100 * change.moved:.0f} cm", turned, size)


def _score_cell(score: Mapping[str, Any] | None, key: str) -> str:
    before, after = ((score or {}).get(k) or {} for k in ("initial", "result"))
    return f"{write_quantity(key, before.get(key), False)} → {write_quantity(key, after.get(key))}"


def write_value(value: Any) -> str:  # noqa: ANN401
    """Any plain value as HTML text."""
    match value:
        case None:
            return NOTHING
        case bool():
            return "yes" if value else "no"
        case int():
            return f"{value:,}"
        case float():
            return f"{value:.3g}" if math.isfinite(value) else NOTHING
        case list() | tuple():
            return ", ".join(write_value(v) for v in value) or NOTHING
        case _:
            return escape(str(value))


def _is_number(value: Any) -> bool:  # noqa: ANN401
    return isinstance(value, int | float) and not isinstance(value, bool)


def _table(head: str, rows: Sequence[str]) -> str:
    return f'<div class="wide"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def stage_bars(stages: Sequence[Mapping[str, Any]]) -> str:
    """Seconds (as bars) and peak memory of each stage."""
    longest = max([float(s.get("seconds") or 0) for s in stages], default=0.0) or 1.0
    parts: list[str] = []
    for stage in stages:
        seconds, memory = float(stage.get("seconds") or 0), stage.get("memory")
        kept = ' <span class="quiet">(from disk)</span>' if stage.get("kept") else ""
        size = f"{float(memory):,.0f} MB" if _is_number(memory) else ""
        parts.append(
            f"<span>{escape(str(stage.get('name', '')))}{kept}</span>"
            f'<span class="bar" style="--share:{100 * seconds / longest:.1f}%"><i></i></span>'
            f'<span class="number">{seconds:,.1f} s</span><span class="number memory">{size}</span>'
        )
    return f'<div class="stages">{"".join(parts)}</div>' if parts else ""


def warnings_box(warnings: Sequence[str]) -> str:
    """What the user should know before trusting the result."""
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(w)}</li>" for w in warnings)
    title = "1 warning" if len(warnings) == 1 else f"{len(warnings)} warnings"
    state = " open" if len(warnings) <= 5 else ""
    return f'<details class="warnings"{state}><summary>{title}</summary><ul>{items}</ul></details>'


def config_list(config: Mapping[str, Any]) -> str:
    """Each setting under its full name, `place.weights.depth`."""
    items = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(json.dumps(value, default=str))}</dd>"
        for name, value in _leaves(config)
    )
    return f'<dl class="config">{items}</dl>' if items else ""


def _leaves(tree: Mapping[str, Any], above: str = "") -> list[tuple[str, Any]]:
    leaves: list[tuple[str, Any]] = []
    for key, value in tree.items():
        name = f"{above}.{key}" if above else str(key)
        leaves += _leaves(value, name) if isinstance(value, Mapping) and value else [(name, value)]
    return leaves
