"""The numbers of one object as a table."""

import math
from collections.abc import Mapping
from typing import Any

from ..geometry.boxes import box_of
from ..report_numbers import QUANTITIES, write_quantity
from ..report_tables import find_changes
from ..types import Piece, Scene
from .result import Shown

WORDS = {
    "mask_pixels": "pixels of its mask",
    "near_pixels": "pixels where people passed before it",
    "far_pixels": "pixels where it hid people",
    "touching_bodies": "bodies that touch it",
    "energy": "energy that is left",
}


def numbers_of(piece: Piece, scene: Scene, shown: Shown) -> str:
    """A table in Markdown: place, size, what the run did, its evidence, its metrics."""
    box = box_of(piece)
    x, y, z = box.center.tolist()
    width, height, depth = (100 * v for v in box.size.tolist())
    rows = [
        ("category", piece.category),
        ("centre x, y, z", f"{x:.2f}, {y:.2f}, {z:.2f} m"),
        ("front", f"{math.degrees(float(piece.yaw)):.0f}°"),
        ("width, height, depth", f"{width:.0f}, {height:.0f}, {depth:.0f} cm"),
        ("stands on", piece.support),
        *_change(piece, scene, shown),
        *_evidence(piece, shown.log),
        *_metrics(piece, shown.metrics),
    ]
    lines = [f"| {name} | {value} |" for name, value in rows]
    return "\n".join([f"| **{piece.id}** | |", "|---|---|", *lines])


def _change(piece: Piece, scene: Scene, shown: Shown) -> list[tuple[str, str]]:
    change = find_changes(shown.initial, scene).get(piece.id)
    if change is None:
        return [("before", "not there")]
    grown = ", ".join(f"{factor:.2f}" for factor in change.grown)
    return [
        ("moved since the start", f"{100 * change.moved:.0f} cm"),
        ("turned", f"{math.degrees(change.turned):+.0f}°"),
        ("grown", grown),
    ]


def _evidence(piece: Piece, log: Mapping[str, Any]) -> list[tuple[str, str]]:
    row = next((r for r in log.get("evidence", ()) if r.get("id") == piece.id), {})
    return [
        (text, f"{row[key]:,}" if isinstance(row[key], int) else f"{row[key]:.3f}")
        for key, text in WORDS.items()
        if isinstance(row.get(key), int | float)
    ]


def _metrics(piece: Piece, metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    row = next((r for r in metrics.get("objects", ()) if r.get("id") == piece.id), {})
    before, after = row.get("initial") or {}, row.get("result") or {}
    return [
        (
            QUANTITIES[key].label,
            f"{write_quantity(key, before.get(key))} → {write_quantity(key, value)}",
        )
        for key, value in after.items()
        if key in QUANTITIES
    ]
