"""What stated doubts are multiplied by, so that 90 % of them hold: learnt on known rooms.

`calibration.json` is made by `benchmarks/calibrate.py`; its rooms are never those that
results are reported on.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from mover.energy.config import Variant

KIND_OF = ("distance", "height", "sideways", "yaw", "size", "size", "size")
"""What is calibrated together, by direction (`explanation.ways_of`); the factor of the height
holds for all that the camera's and the floor's doubt does."""
KINDS = (*dict.fromkeys(KIND_OF), "roll")
"""`roll`: the factor of what the camera's doubt does across the ray: objects tell its roll better
than the feet do, of which the stated doubt is."""
FILE = "calibration.json"
FORMAT, VERSION = "mover-calibration", 3
GROWING = tuple(kind for kind in KINDS if kind not in ("height", "roll"))
"""What is known less well of an object whose silhouette does not fit its mask."""
MISFIT = 0.2  # [1], share of a silhouette: spreads grow by a power of (1 + misfit / MISFIT)


@dataclass(frozen=True)
class Calibration:
    """Factors on the spreads that the energy gives, by kind of unknown."""

    factors: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(KINDS, 1.0))
    powers: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(GROWING, 0.0))
    """How fast the spreads of each kind grow with the misfit of the silhouette."""
    share: float = 1.0
    """Weight of an alternative whose energy is as low as that of the result, which has 1."""
    learnt: bool = False
    """False: nothing was learnt for these settings."""


def calibration_of(form: Variant) -> Calibration:
    """What is known for a form of the prices; factors of one where nothing is."""
    text = files("mover.evaluate").joinpath(FILE).read_text(encoding="utf-8")
    learnt = forms_of(json.loads(text)).get(form)
    return Calibration() if learnt is None else learnt


def forms_of(tree: Mapping[str, Any]) -> dict[str, Calibration]:
    """The calibrations of a file, by form.

    Raises:
        ValueError: If the file is of another kind or version, or names what is not known.
    """
    if (tree.get("format"), tree.get("version")) != (FORMAT, VERSION):
        raise ValueError(f"{FILE}: not {FORMAT} of version {VERSION}")
    return {form: _read(row) for form, row in tree["forms"].items()}


def _read(row: Mapping[str, Any]) -> Calibration:
    for name, kinds in (("factors", KINDS), ("powers", GROWING)):
        if set(row[name]) != set(kinds):
            raise ValueError(f"{FILE}: kinds of {name} are {', '.join(kinds)}")
    return Calibration(row["factors"], row["powers"], row["share"], True)


def growth(overlap: float | None) -> float:
    """What is raised to the power of a kind: one where the silhouette fits its mask.

    Args:
        overlap: IoU of silhouette and mask; None: there is no mask, and nothing misfits.
    """
    return 1.0 if overlap is None else 1 + (1 - overlap) / MISFIT
