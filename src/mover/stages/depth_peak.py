"""The factor of depth at which bodies fill their masks best, and that of their heights.

Errors of the pose bias both, as far as bodies cannot be made to fill their masks: the misfit, one
minus the best overlap. Learnt on development rooms of the known rooms with pose errors of 0, 4 and
8 degrees a joint (seeds 100 to 129): overlaps put people too far, by 1 % from a misfit of 0.3 on;
heights, since bent bodies are lower, put them too near by 1 % there and by more beyond.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

SYSTEMATIC = 0.003  # error of the factor that more frames do not make smaller

COMMON = 0.006  # of a factor whose bias is corrected: what is left of it, and differs by person
FREE, FULL = 0.05, 0.3  # misfits from which on overlaps are biased, and are so no more than there
FAR = 0.04  # of the factor by overlaps, for a misfit
BENT, NEAR = 0.15, 0.07  # misfit from which on heights are biased, and how much


@dataclass(frozen=True)
class Peak:
    """What overlaps, or overlaps and heights, say of a person's depth."""

    factor: float
    """True depth over the given one."""
    spread: float
    """Standard deviation of `factor`; inf where nothing is known."""
    misfit: float
    """One minus the best mean overlap of bodies and masks; `FULL` where none was compared."""
    warnings: tuple[str, ...] = ()
    """Why the factor may not be used."""

    @property
    def lower(self) -> float:
        """What heights say too little, by errors of the pose."""
        return NEAR * max(0.0, self.misfit - BENT)


@runtime_checkable
class Rules(Protocol):
    """When a factor is believed."""

    @property
    def span(self) -> float:
        """Factors from 1 - span to 1 + span were tried."""
        ...

    @property
    def least(self) -> int:
        """Fewer bodies than that tell nothing."""
        ...

    @property
    def spread(self) -> float:
        """A factor less certain than that is not used."""
        ...


def peak_of(curves: Float[Tensor, "used factors"], rules: Rules) -> Peak:
    """Best factor by a parabola, its spread, and why it may not be used."""
    factors = curves.shape[1]
    if len(curves) < rules.least:
        seen = f"{len(curves)} of at least {rules.least} bodies are seen well enough"
        return _unknown(f"{seen}, it stays as given")
    total = curves.double().mean(0)
    best, reach = int(total.argmax()), max(2, factors // 6)
    low, high = max(0, best - reach), min(factors, best + reach + 1)
    grid = torch.linspace(-rules.span, rules.span, factors).double()
    x = grid[low:high] - grid[best]
    design = torch.stack([x.square(), x, torch.ones_like(x)], -1)
    bend, slope, _ = torch.linalg.lstsq(design, total[low:high]).solution.tolist()
    if bend >= 0 or best in (0, factors - 1):
        wrong = f"more than {100 * rules.span:.0f} % wrong or unclear, it stays as given"
        return _unknown(wrong)
    factor = 1 + float(grid[best]) - slope / (2 * bend)
    each = torch.linalg.lstsq(design, curves.double()[:, low:high].mT).solution
    lean = each[1] + 2 * each[0] * (factor - 1 - float(grid[best]))
    error = float(lean.std()) / len(curves) ** 0.5 / abs(2 * bend)
    spread = (error**2 + SYSTEMATIC**2) ** 0.5
    if spread > rules.spread:
        return _unknown(f"uncertain by {100 * spread:.1f} %, it stays as given")
    misfit = 1 - float(total.max())
    farther = FAR * max(0.0, min(misfit, FULL) - FREE)
    return Peak(factor - farther, spread, misfit)


def fused(factors: list[tuple[float, float]]) -> tuple[float, float]:
    """Mean of (factor, spread) by their certainty, and its spread."""
    weights = [1 / (spread**2 + COMMON**2) for _, spread in factors]
    whole = sum(weights)
    mean = sum(w * factor for w, (factor, _) in zip(weights, factors, strict=True)) / whole
    return mean, whole**-0.5


def _unknown(why: str) -> Peak:
    return Peak(1.0, float("inf"), FULL, (why,))
