"""What a descent reports: its energy, term by term, and each of its steps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

PerItem = Float[Tensor, "*items"]


@dataclass(frozen=True)
class Energy:
    """Weighted terms of an objective, before any sum over the items (objects or frames)."""

    parts: Mapping[str, PerItem]
    whole: PerItem | None = None  #: their sum, where it is known

    @property
    def per_item(self) -> PerItem:
        """Sum of the terms for each item."""
        if self.whole is not None:
            return self.whole
        return torch.stack(list(self.parts.values())).sum(0)

    @property
    def total(self) -> Float[Tensor, ""]:
        """The number to minimise."""
        return self.per_item.sum()


@dataclass(frozen=True)
class Step:
    """What an observer sees after each step."""

    stage: str
    index: int
    steps: int
    energy: Energy | None = None


Observer = Callable[[Step], None]


def silent(_step: Step) -> None:
    """Observe nothing."""
