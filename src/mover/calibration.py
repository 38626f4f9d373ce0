"""What stated doubts are multiplied by, so that 90 % of them hold: learnt on known rooms.

`assets/calibration.json` is made by `benchmarks/calibrate.py`; its rooms are never those that
results are reported on.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .terms import Form

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
SHARES = tuple(0.01 * 1.2**k for k in range(30))  # weights that are tried
SCALES = tuple(1e-3 * 1.1**k for k in range(100))  # factors that are tried for likelihoods


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


def calibration_of(form: Form) -> Calibration:
    """What is known for a form of the prices; factors of one where nothing is."""
    text = files("mover").joinpath("assets", FILE).read_text(encoding="utf-8")
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


def learn_factor(needed: Sequence[float], level: float) -> float:
    """The factor with which intervals hold a share `level` of errors (split conformal prediction).

    Args:
        needed: For each error the least factor with which its interval holds it.
        level: The probability that an interval holds.

    Raises:
        ValueError: If there are too few errors for that probability.
    """
    rank = math.ceil(level * (len(needed) + 1) - 1e-9)
    if rank > len(needed):
        raise ValueError(f"learn_factor: {len(needed)} errors are too few for {level:.0%}")
    return sorted(needed)[rank - 1]


def surprise(
    own: Float[Tensor, " errors"], rest: Float[Tensor, " errors"], errors: Float[Tensor, " errors"]
) -> float:
    """How unlikely errors are whose variances are said to be `own` times some factor plus `rest`.

    Errors count as Student's t with two degrees of freedom: a wrong yaw is as wrong as can be, and
    must not decide alone. The factor is the one with which they are likeliest.
    """
    square = torch.tensor(SCALES, dtype=torch.float64).square()[:, None] * own + rest
    square = square.clamp_min(1e-12)
    each = square.log() / 2 + 1.5 * (1 + errors.square() / square / 2).log()
    return float(each.sum(1).min())


def learn_share(cases: Sequence[tuple[Sequence[float], int]]) -> float:
    """The weight of alternatives under which it was likeliest that the true ones were true.

    Args:
        cases: For each object the rises of its alternatives, and which one is nearest to the
            truth, counted from 1; 0: the result itself. Objects without alternatives say nothing.
    """
    told = [(rises, true) for rises, true in cases if rises]

    def unlikely(share: float) -> float:
        total = 0.0
        for rises, true in told:
            weights = [1.0, *(share * math.exp(-max(r, 0.0)) for r in rises)]
            total -= math.log(weights[true] / sum(weights))
        return total

    return min(SHARES, key=unlikely) if told else 1.0
