"""The report's numbers: objects, metrics, stages and settings, and how each is written."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from mover.app.report import fill
from mover.core.colours import colour, css
from mover.core.types import Scene, SceneObject
from mover.evaluate.evaluation import METRICS
from mover.evaluate.scene import Metric
from mover.evaluate.stability import PHYSICS_METRICS
from mover.geometry.camera import to_camera
from mover.geometry.placement import place_object
from mover.geometry.rotations import wrap

NOTHING = "\N{EN DASH}"
QUANTITIES: dict[str, Metric[Any]] = {**METRICS, **PHYSICS_METRICS}
"""How the numbers of metrics.json are shown, in their order."""


SHOWN = {
    "": ("", 1.0, 3), "share": ("%", 100.0, 1), "m": ("cm", 100.0, 1),
    "rad": ("°", math.degrees(1), 2),
}  # fmt: skip
"""The unit in which a number of a unit is shown, its factor and its digits."""


def shown(unit: str, value: float | None, *, sign: bool = False, named: bool = False) -> str:
    """A number of a metric as people read it; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NOTHING
    name, factor, digits = SHOWN[unit]
    rounded = round(factor * value, digits) + 0.0  # no negative zero
    text = f"{rounded:{'+' if sign else ''}.{digits}f}".replace("-", "\N{MINUS SIGN}")
    space = "\N{NO-BREAK SPACE}" if name not in ("", "°") else ""
    return text + space + name if named else text


def write_value(value: Any) -> str:  # noqa: ANN401
    """Any plain value as text."""
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
            return str(value)


JUDGED = {"iou3d": "3D IoU", "center_error": "Centre error"}  # beside each object


@dataclass(frozen=True)
class Change:
    """What the run did to an object."""

    moved: float  #: distance between the centres of its box, seen from the camera [m]
    turned: float  #: turn about its own vertical [rad]
    grown: tuple[float, ...]  #: factor of its size along each of its axes


def find_changes(initial: Scene, result: Scene) -> dict[str, Change]:
    """What happened to each object that both scenes hold."""

    def centre(item: SceneObject, scene: Scene) -> torch.Tensor:
        verts = place_object(item).verts[item.mesh.faces.unique()]
        return to_camera((verts.amin(0) + verts.amax(0)) / 2, scene.camera.R_cam_world)

    old = {item.id: item for item in initial.objects}
    return {
        item.id: Change(
            float((centre(item, result) - centre(old[item.id], initial)).norm()),
            float(wrap(item.yaw - old[item.id].yaw)),
            tuple((item.scale / old[item.id].scale).tolist()),
        )
        for item in result.objects
        if item.id in old
    }


@dataclass(frozen=True)
class Cell:
    """One cell of a table."""

    text: str
    kind: str = ""  #: a class of report.css
    tint: str = ""  #: colour of a dot before the text


def draw_table(titles: Sequence[Cell], rows: Sequence[Sequence[Cell]]) -> str:
    """A table whose rows begin with their heads; without rows there is none."""
    return fill("table.html", titles=titles, rows=rows) if rows else ""


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Each metric before and after, coloured by whether it became better."""
    before, after = metrics.get("initial") or {}, metrics.get("result") or {}
    every = dict.fromkeys((*(k for k in QUANTITIES if k in before or k in after), *before, *after))
    kinds = {k: type(before.get(k, after.get(k))) for k in every}
    keys = [k for k in every if k in QUANTITIES or kinds[k] in (int, float)]
    rows = [_metric_row(k, before.get(k), after.get(k)) for k in keys]
    return draw_table([Cell("Metric", "text"), *map(Cell, ("Before", "After", "Change"))], rows)


def metric_of(key: str) -> Metric[Any]:
    """How a number of metrics.json is shown; one that is not known as it is."""
    return QUANTITIES.get(key) or Metric(key, "", 0.0, lambda _: None)


def _metric_row(key: str, before: float | None, after: float | None) -> list[Cell]:
    metric, change, mood = metric_of(key), NOTHING, ""
    if before is not None and after is not None:
        change = shown(metric.unit, after - before, sign=True)
        if key in QUANTITIES and any(c in "123456789" for c in change):
            mood = "better" if (after > before) == (metric.best > 0) else "worse"
    both = (shown(metric.unit, value, named=True) for value in (before, after))
    return [Cell(metric.label), *map(Cell, both), Cell(change, mood)]


def objects_table(
    scenes: Mapping[str, Scene],
    rows: Sequence[Mapping[str, Any]],
    metrics: Mapping[str, Any] | None,
) -> str:
    """What happened to each object, and the evidence and numbers that `rows` give for it."""
    changes = find_changes(scenes["initial"], scenes["result"])
    extra = {str(row.get("id")): row for row in rows}
    fields = list(dict.fromkeys(k for row in rows for k in row if k not in ("id", "category")))
    scores = {str(o.get("id")): o for o in (metrics or {}).get("objects") or ()}
    judged = [k for k in JUDGED if any(k in (o.get("result") or {}) for o in scores.values())]
    titles = ["Moved", "Turned", "Size", *(JUDGED[k] for k in judged)]
    titles += [f.replace("_", " ") for f in fields]
    lines: list[list[Cell]] = []
    for index, item in enumerate(scenes["result"].objects):
        sides = [(scores.get(item.id) or {}).get(side) or {} for side in ("initial", "result")]
        values = _change_cells(changes.get(item.id))
        for key in judged:
            before, after = (side.get(key) for side in sides)
            unit = metric_of(key).unit
            values.append(f"{shown(unit, before)} → {shown(unit, after, named=True)}")
        values += [write_value(extra.get(item.id, {}).get(f)) for f in fields]
        head = [Cell(item.id, tint=css(colour(index))), Cell(item.category, "text")]
        lines.append([*head, *map(Cell, values)])
    return draw_table([Cell("Object"), Cell("Category", "text"), *map(Cell, titles)], lines)


def _change_cells(change: Change | None) -> list[str]:
    if change is None:
        return ["new", NOTHING, NOTHING]
    grown = [f"{100 * (g - 1):+.0f}" for g in change.grown]
    size = grown[0] if len(set(grown)) == 1 else " / ".join(grown)
    cells = [f"{100 * change.moved:.0f} cm", f"{math.degrees(change.turned):+.1f}°", f"{size} %"]
    return [cell.replace("-", "\N{MINUS SIGN}") for cell in cells]


def settings_of(config: Mapping[str, Any], above: str = "") -> list[tuple[str, str]]:
    """Each setting under its full name, `place.weights.depth`."""
    leaves: list[tuple[str, str]] = []
    for key, value in config.items():
        name = f"{above}.{key}" if above else str(key)
        if isinstance(value, Mapping) and value:
            leaves += settings_of(value, name)
        else:
            leaves.append((name, json.dumps(value, default=str)))
    return leaves
