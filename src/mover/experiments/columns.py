"""Columns of the studies' tables: what a metric is called, in which unit, and which way is good."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Column:
    """How a metric is shown."""

    title: str
    better: int = 1
    """1: larger is better, -1: smaller, 0: neither (it is compared with the truth's own)."""
    unit: str = ""
    factor: float = 1.0
    """From metres, radians or shares to the unit."""
    digits: int = 3


DEGREES = 57.29577951308232
COLUMNS: dict[str, Column] = {
    "iou3d": Column("IoU3D"),
    "p2s": Column("P2S", -1, "cm", 100, 1),
    "iou2d": Column("IoU2D"),
    "non_collision": Column("Non-Col"),
    "contact": Column("Cont.", 0),
    "contact_f1": Column("contact F1"),
    "yaw_error": Column("yaw", -1, "°", DEGREES, 1),
    "center_error": Column("centre", -1, "cm", 100, 1),
    "size_error": Column("size", -1, "cm", 100, 1),
    "iou3d_touched": Column("IoU3D touched"),
    "iou3d_untouched": Column("IoU3D untouched"),
    "pitch_error": Column("pitch", -1, "°", DEGREES, 2),
    "roll_error": Column("roll", -1, "°", DEGREES, 2),
    "tilt": Column("mean", -1, "°", DEGREES, 2),
    "ground_error": Column("floor", -1, "cm", 100, 1),
    "ground_penetration_frequency": Column("Ground Pen. Freq.", -1),
    "ground_penetration_distance": Column("Ground Pen. Dist.", -1, "cm", 100, 1),
    "pje": Column("PJE", -1, "mm", 1000, 1),
    "v2v": Column("V2V", -1, "mm", 1000, 1),
    "p_pje": Column("p.PJE", -1, "mm", 1000, 1),
    "p_v2v": Column("p.V2V", -1, "mm", 1000, 1),
}
ARROWS = {1: " ↑", -1: " ↓", 0: ""}


def head_of(metric: str) -> str:
    """Head of a column: name, unit, and the better side."""
    column = COLUMNS[metric]
    unit = f" [{column.unit}]" if column.unit else ""
    return f"{column.title}{unit}{ARROWS[column.better]}"


def shown(metric: str, value: float | None, *, sign: bool = False) -> str:
    """A value in the unit of its column; `-` where there is none."""
    if value is None:
        return "-"
    column = COLUMNS[metric]
    rounded = round(column.factor * value, column.digits) + 0.0  # no negative zero
    return f"{rounded:{'+' if sign else ''}.{column.digits}f}"


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table: the first column on the left, the others on the right."""
    rule = ["---", *["--:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))
