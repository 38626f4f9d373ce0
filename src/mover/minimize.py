"""Objectives as named terms, robust losses, and gradient descent on a record of tensors."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from .records import map_tensors

P = TypeVar("P")
PerItem = Float[Tensor, "*items"]


def geman_mcclure(residual: Float[Tensor, "*any"], rho: float) -> Float[Tensor, "*any"]:
    """Robust price r^2 / (r^2 + rho^2) in [0, 1); one half where |r| = rho."""
    squared = residual.square()
    return squared / (squared + rho**2)


def safe_norm(x: Float[Tensor, "*any axis"], eps: float = 1e-12) -> Float[Tensor, "*any"]:
    """Length of the last axis with a finite gradient at zero."""
    return (x.square().sum(-1) + eps).sqrt() - eps**0.5


@dataclass(frozen=True)
class Energy:
    """Weighted terms of an objective, before any sum over the items (objects or frames)."""

    parts: Mapping[str, PerItem]

    @property
    def per_item(self) -> PerItem:
        """Sum of the terms for each item."""
        return torch.stack(list(self.parts.values())).sum(0)

    @property
    def total(self) -> Float[Tensor, ""]:
        """The number to minimise."""
        return self.per_item.sum()


def weigh(*terms: tuple[str, float, Callable[[], PerItem]]) -> Energy:
    """Sum named terms; one with weight zero is neither computed nor needs its evidence."""
    return Energy({name: weight * term() for name, weight, term in terms if weight != 0.0})


@dataclass(frozen=True)
class Adam:
    """Adam with a step that falls geometrically from `rate` to `last_rate`."""

    steps: int = 3000
    """Number of steps."""
    rate: float = 0.002
    """First step size (Sec. "Optimization" of the supplement)."""
    last_rate: float = 0.002
    """Last step size; equal to `rate`: constant."""
    beta2: float = 0.999
    """Memory of the squared gradient."""
    keep_best: bool = False
    """Return the best state of each item instead of the last one."""


@dataclass(frozen=True)
class Step:
    """What an observer sees after each step."""

    stage: str
    index: int
    steps: int
    energy: Energy | None = None
    at: Callable[[], Any] | None = None
    """Gives the state after the step; not called unless somebody draws it."""


Observer = Callable[[Step], None]


def silent(_step: Step) -> None:
    """Observe nothing."""


@dataclass(frozen=True)
class Minimum(Generic[P]):
    """Where the descent ended."""

    at: P
    value: Float[Tensor, "*items"]
    """Energy of each item there."""
    trace: Float[Tensor, " steps"]
    """Total energy before each step."""


def minimize(
    energy: Callable[[P], Energy],
    start: P,
    method: Adam,
    observe: Observer = silent,
    stage: str = "",
) -> Minimum[P]:
    """Follow the gradient of `energy` from `start`.

    Every field of `P` is a tensor; with `keep_best` its leading axes are those of the items.

    Raises:
        ValueError: If the energy stops being finite.
    """
    names = [f.name for f in dataclasses.fields(start)]  # type: ignore[arg-type]
    free = {n: getattr(start, n).detach().clone().requires_grad_() for n in names}
    at = dataclasses.replace(start, **free)  # type: ignore[type-var]
    adam = torch.optim.Adam(list(free.values()), lr=method.rate, betas=(0.9, method.beta2))
    best, lowest = map_tensors(lambda x: x.detach().clone(), at), None
    trace: list[Tensor] = []
    for index in range(method.steps):
        adam.param_groups[0]["lr"] = _rate(method, index)
        adam.zero_grad()
        value = energy(at)
        value.total.backward()
        items = value.per_item.detach()
        if method.keep_best:
            lowest, best = _better(items, lowest, at, best)
        trace.append(items.sum())
        adam.step()
        observe(Step(stage, index, method.steps, value, lambda: at))
    with torch.no_grad():
        last = energy(at).per_item
    if not torch.stack([*trace, last.sum()]).isfinite().all():
        raise ValueError(f"{stage}: the energy is not finite")
    if method.keep_best:
        last, at = _better(last, lowest, at, best)
    at = map_tensors(lambda x: x.detach(), at)
    return Minimum(at, last, torch.stack(trace) if trace else last.new_zeros(0))


def _rate(method: Adam, index: int) -> float:
    share = index / max(1, method.steps - 1)
    return method.rate * (method.last_rate / method.rate) ** share


def _better(items: Tensor, lowest: Tensor | None, at: P, best: P) -> tuple[Tensor, P]:
    """Keep, item by item, the state with the lowest energy so far."""
    if lowest is None:
        return items.clone(), map_tensors(lambda x: x.detach().clone(), at)
    wins = items < lowest
    kept = {}
    for field in dataclasses.fields(at):  # type: ignore[arg-type]
        new, old = getattr(at, field.name).detach(), getattr(best, field.name)
        mask = wins.reshape(wins.shape + (1,) * (new.ndim - wins.ndim))
        kept[field.name] = torch.where(mask, new, old)
    return torch.where(wins, items, lowest), dataclasses.replace(best, **kept)  # type: ignore[type-var]
