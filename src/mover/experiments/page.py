"""The page of an experiment: Markdown tables in centimetres and degrees."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ..evaluate import METRICS
from .job import STAGES

UNITS = {"m": ("cm", 100.0, 1), "rad": ("°", math.degrees(1.0), 1), "": ("", 1.0, 3)}
"""How a unit is shown: its name, the factor, digits after the point."""
FINE = {"pitch_error": 2, "roll_error": 2}  # digits of those whose goal is below a degree
TITLES = {
    "iou3d": "IoU3D", "p2s": "P2S", "iou2d": "IoU2D", "yaw_error": "yaw", "center_error": "centre",
    "size_error": "size", "contact_f1": "contact F1", "non_collision": "non-collision",
    "contact": "contact", "penetration_depth": "penetration", "pitch_error": "pitch",
    "roll_error": "roll", "ground_error": "ground",
}  # fmt: skip


@dataclass(frozen=True)
class Line:
    """A mean over rooms or objects of one stage of one preset."""

    over: str
    """What the mean runs over."""
    preset: str
    """Empty: the initial scene."""
    stage: str
    count: int
    """How many rooms or objects it is a mean of."""
    values: Mapping[str, float]
    """Metrics [m], [rad]; and counts of objects that are `turned` or `bad`."""


def fill_page(command: str, made_by: str, lines: Sequence[Line], notes: Sequence[str]) -> str:
    """The whole page but for the pictures."""
    kinds = ("touched", "untouched", "hidden", "truncated", "flipped")
    objects = ("objects", *(f"{kind} objects" for kind in kinds))
    few = ("iou3d", "p2s", "iou2d", "yaw_error", "center_error", "size_error")
    parts = [
        "# Known rooms",
        f"    {command}",
        made_by,
        *notes,
        "Stage 1 places the objects by the image alone, under the camera that the full method"
        " found. Arrows point to the better side.",
        "## Mean over rooms",
        _table([x for x in lines if x.over == "rooms"], tuple(TITLES), "rooms"),
    ]
    for over in objects:
        some = [x for x in lines if x.over == over]
        if some:
            parts += [f"## Mean over {over}", _table(some, few, "objects", counts=True)]
    parts += ["## IoU3D of each room", _by_room(lines, ("iou3d",), tuple(STAGES))]
    camera = ("pitch_error", "roll_error", "ground_error")
    title = " / ".join(title_of(name).removesuffix(" ↓") for name in camera)
    parts += [f"## {title} of each room", _by_room(lines, camera, ("initial", "full"))]
    return "\n\n".join(parts) + "\n"


def title_of(name: str) -> str:
    """Head of a column: name, unit, and the better side."""
    metric = METRICS[name]
    unit = UNITS[metric.unit][0]
    better = "↑" if metric.best else "↓"
    return f"{TITLES[name]} [{unit}] {better}" if unit else f"{TITLES[name]} {better}"


def shown(name: str, values: Mapping[str, float]) -> str:
    """A value in the unit of its column."""
    if name not in values:
        return "-"
    _, factor, digits = UNITS[METRICS[name].unit]
    return f"{values[name] * factor:.{FINE.get(name, digits)}f}"


def label_of(line: Line) -> str:
    """Preset and stage in words."""
    return f"{line.preset}, {STAGES[line.stage]}" if line.preset else STAGES[line.stage]


def _table(lines: Sequence[Line], names: Sequence[str], of: str, *, counts: bool = False) -> str:
    head = ["", *(title_of(name) for name in names)]
    head += ["turned > 45° ↓", "IoU3D < .25 ↓"] if counts else []
    rows = [
        [label_of(x), *(shown(name, x.values) for name in names)]
        + ([f"{x.values['turned']:.0f}", f"{x.values['bad']:.0f}"] if counts else [])
        + [str(x.count)]
        for x in lines
    ]
    return _markdown([*head, of], rows)


def _by_room(lines: Sequence[Line], names: Sequence[str], stages: Sequence[str]) -> str:
    """One column for each preset and stage, one row for each room."""
    rooms = [x for x in lines if x.over.startswith("room ") and x.stage in stages]
    labels = list(dict.fromkeys(label_of(x) for x in rooms))
    cells = {(x.over, label_of(x)): " / ".join(shown(n, x.values) for n in names) for x in rooms}
    rows = [
        [over, *(cells.get((over, label), "-") for label in labels)]
        for over in dict.fromkeys(x.over for x in rooms)
    ]
    return _markdown(["", *labels], rows)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    rule = ["---"] + ["--:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))
