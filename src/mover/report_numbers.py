"""How the report writes numbers: names, units and signs."""

import math
from dataclasses import dataclass
from html import escape
from typing import Any

NOTHING = "\N{EN DASH}"


@dataclass(frozen=True)
class Quantity:
    """How a number of metrics.json is written."""

    label: str
    unit: str = ""
    factor: float = 1.0
    digits: int = 3
    more_is_better: bool = False
    short: str = ""
    """Title of a narrow column."""


_CM, _DEG, _PERCENT = ("cm", 100.0, 1), ("°", 180 / math.pi, 2), ("%", 100.0, 1)
QUANTITIES = {
    "iou3d": Quantity("3D overlap with the truth (IoU)", more_is_better=True, short="3D IoU"),
    "iou2d": Quantity("Overlap of the image boxes (IoU)", more_is_better=True),
    "p2s": Quantity("True surface to estimated surface", *_CM),
    "center_error": Quantity("Error of the centre", *_CM, short="Centre error"),
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
    "foot_skate": Quantity("Speed of feet on the floor", "cm/s", 100.0, 1),
    "float_height": Quantity("Height of the lower foot over the floor", *_CM),
    "acceleration_error": Quantity("Error of the joints' acceleration", "m/s²", 1.0, 2),
}


def write_quantity(key: str, value: float | None, unit: bool = True) -> str:
    """A number of metrics.json with its unit."""
    quantity = QUANTITIES.get(key, Quantity(key))
    if value is None or not math.isfinite(value):
        return NOTHING
    text = f"{quantity.factor * value:.{quantity.digits}f}"
    if not unit or not quantity.unit:
        return text
    return text + ("" if quantity.unit == "°" else "\N{NO-BREAK SPACE}") + quantity.unit


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


def is_number(value: Any) -> bool:  # noqa: ANN401
    """Whether a plain value is a number, not a truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def signed(value: float, digits: int) -> str:
    """A number with its sign, a true minus."""
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}")
