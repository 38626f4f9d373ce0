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
from .report_numbers import (
    NOTHING,
    QUANTITIES,
    Quantity,
    is_number,
    signed,
    write_quantity,
    write_value,
)
from .types import Piece, Scene

JUDGED = ("iou3d", "center_error")  # metrics that stand beside each object


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


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Each metric before and after, coloured by whether it became better."""
    before, after = metrics.get("initial") or {}, metrics.get("result") or {}
    keys = [k for k in QUANTITIES if k in before or k in after]
    keys += [
        k
        for k in (*before, *after)
        if k not in QUANTITIES and is_number(before.get(k, after.get(k)))
    ]
    rows = [_metric_row(k, before.get(k), after.get(k)) for k in dict.fromkeys(keys)]
    head = '<tr><th class="text">Metric</th><th>Before</th><th>After</th><th>Change</th></tr>'
    return _table(head, rows) if rows else ""


def _metric_row(key: str, before: float | None, after: float | None) -> str:
    quantity = QUANTITIES.get(key, Quantity(key))
    change, mood = NOTHING, ""
    if before is not None and after is not None and math.isfinite(before) and math.isfinite(after):
        grown = quantity.factor * (after - before)
        change = signed(grown, quantity.digits)
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
    judged = [k for k in JUDGED if any(k in (o.get("result") or {}) for o in scores.values())]
    titles = ["Moved", "Turned", "Size", *(QUANTITIES[k].short for k in judged)]
    titles += [f.replace("_", " ") for f in fields]
    cells = "".join(f"<th>{escape(t)}</th>" for t in titles)
    head = f'<tr><th>Object</th><th class="text">Category</th>{cells}</tr>'
    lines: list[str] = []
    for index, piece in enumerate(result.pieces):
        values = [*_change_cells(changes.get(piece.id))]
        values += [_score_cell(scores.get(piece.id), k) for k in judged]
        values += [write_value(extra.get(piece.id, {}).get(f)) for f in fields]
        lines.append(_object_row(piece, css(colour(index)), values))
    return _table(head, lines) if lines else ""


def _object_row(piece: Piece, tint: str, values: Sequence[str]) -> str:
    dot = f'<span class="dot" style="--tint:{tint}"></span>'
    cells = "".join(f"<td>{v}</td>" for v in values)
    category = f'<td class="text">{escape(piece.category)}</td>'
    return f"<tr><th>{dot}{escape(piece.id)}</th>{category}{cells}</tr>"


def _change_cells(change: Change | None) -> tuple[str, str, str]:
    if change is None:
        return ("new", NOTHING, NOTHING)
    grown = [signed(100 * (g - 1), 0) for g in change.grown]
    size = f"{grown[0]} %" if len(set(grown)) == 1 else f"{' / '.join(grown)} %"
    turned = f"{signed(math.degrees(change.turned), 1)}°"
    return (f"{100 * change.moved:.0f} cm", turned, size)


def _score_cell(score: Mapping[str, Any] | None, key: str) -> str:
    before, after = ((score or {}).get(k) or {} for k in ("initial", "result"))
    return f"{write_quantity(key, before.get(key), False)} → {write_quantity(key, after.get(key))}"


def _table(head: str, rows: Sequence[str]) -> str:
    body = f"<thead>{head}</thead><tbody>{''.join(rows)}</tbody>"
    return f'<div class="wide"><table>{body}</table></div>'


def stage_bars(stages: Sequence[Mapping[str, Any]]) -> str:
    """Seconds (as bars) and peak memory of each stage."""
    longest = max([float(s.get("seconds") or 0) for s in stages], default=0.0) or 1.0
    parts: list[str] = []
    for stage in stages:
        seconds = float(stage.get("seconds") or 0)
        memory = float(stage.get("memory") or stage.get("peak_memory") or 0)
        kept = ' <span class="quiet">(from disk)</span>' if stage.get("kept") else ""
        size = f"{memory:,.0f} MB" if memory else ""
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
