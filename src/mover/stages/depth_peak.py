"""The factor of depth at which bodies fill their masks best."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

SYSTEMATIC = 0.003  # error of the factor that more frames do not make smaller

Peak = tuple[float, float, list[str]]
"""Factor, its spread, and why it may not be used."""


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
    unknown, factors = (1.0, float("inf")), curves.shape[1]
    if len(curves) < rules.least:
        seen = f"{len(curves)} of at least {rules.least} bodies are seen well enough"
        return *unknown, [f"{seen}, it stays as given"]
    total = curves.double().mean(0)
    best, reach = int(total.argmax()), max(2, factors // 6)
    low, high = max(0, best - reach), min(factors, best + reach + 1)
    grid = torch.linspace(-rules.span, rules.span, factors).double()
    x = grid[low:high] - grid[best]
    design = torch.stack([x.square(), x, torch.ones_like(x)], -1)
    bend, slope, _ = torch.linalg.lstsq(design, total[low:high]).solution.tolist()
    if bend >= 0 or best in (0, factors - 1):
        wrong = f"more than {100 * rules.span:.0f} % wrong or unclear, it stays as given"
        return *unknown, [wrong]
    factor = 1 + float(grid[best]) - slope / (2 * bend)
    each = torch.linalg.lstsq(design, curves.double()[:, low:high].mT).solution
    lean = each[1] + 2 * each[0] * (factor - 1 - float(grid[best]))
    error = float(lean.std()) / len(curves) ** 0.5 / abs(2 * bend)
    spread = (error**2 + SYSTEMATIC**2) ** 0.5
    if spread > rules.spread:
        return *unknown, [f"uncertain by {100 * spread:.1f} %, it stays as given"]
    return factor, spread, []
