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
    whole: PerItem | None = None
    """Their sum, where it is known."""

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
    free = _Unknowns(start)
    best, lowest = free.at.clone(), None
    trace: list[Tensor] = []
    for index in range(method.steps):
        free.slope.zero_()
        value = energy(free.record)
        value.total.backward()
        items = value.per_item.detach()
        if method.keep_best:
            best, lowest = free.better(items, lowest, best)
        trace.append(items.sum())
        free.step(method, index)
        observe(Step(stage, index, method.steps, value, lambda: free.record))
    with torch.no_grad():
        last = energy(free.record).per_item
    if not torch.stack([*trace, last.sum()]).isfinite().all():
        raise ValueError(f"{stage}: the energy is not finite")
    if method.keep_best:
        best, last = free.better(last, lowest, best)
        free.at.copy_(best)
    at = map_tensors(lambda x: x.detach().clone(), free.record)
    return Minimum(at, last, torch.stack(trace) if trace else last.new_zeros(0))


class _Unknowns(Generic[P]):
    """All fields of a record in one piece of memory, so that a step takes few operations."""

    def __init__(self, start: P) -> None:
        names = [f.name for f in dataclasses.fields(start)]  # type: ignore[arg-type]
        fields = [getattr(start, n).detach() for n in names]
        self.at = torch.cat([x.flatten() for x in fields])
        self.slope, self.mean, self.square = (torch.zeros_like(self.at) for _ in range(3))
        sizes = [x.numel() for x in fields]
        leaves: dict[str, Tensor] = {}
        for name, x, part, grad in zip(
            names, fields, self.at.split(sizes), self.slope.split(sizes), strict=True
        ):
            leaves[name] = part.view(x.shape).detach().requires_grad_()
            leaves[name].grad = grad.view(x.shape)
        self.record: P = dataclasses.replace(start, **leaves)  # type: ignore[type-var]
        self.shapes = [x.shape for x in fields]
        self.owner: Tensor | None = None

    def step(self, method: Adam, index: int) -> None:
        """Adam's step, in the operations of `torch.optim.Adam`."""
        beta1, beta2, grad = 0.9, method.beta2, self.slope
        self.mean.lerp_(grad, 1 - beta1)
        self.square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        spread = (1 - beta2 ** (index + 1)) ** 0.5
        rate = _rate(method, index) / (1 - beta1 ** (index + 1))
        length = (self.square.sqrt() / spread).add_(1e-8)
        self.at.addcdiv_(self.mean, length, value=-rate)

    def better(self, items: Tensor, lowest: Tensor | None, best: Tensor) -> tuple[Tensor, Tensor]:
        """Keep, item by item, the state with the lowest energy so far, and that energy."""
        if lowest is None:
            return self.at.clone(), items.clone()
        if self.owner is None:
            number = torch.arange(items.numel(), device=items.device).view(items.shape)
            parts = [
                number.reshape(items.shape + (1,) * (len(shape) - items.ndim)).expand(shape)
                for shape in self.shapes
            ]
            self.owner = torch.cat([x.flatten() for x in parts])
        wins = items < lowest
        best = torch.where(wins.flatten()[self.owner], self.at, best)
        return best, torch.where(wins, items, lowest)


def _rate(method: Adam, index: int) -> float:
    share = index / max(1, method.steps - 1)
    return method.rate * (method.last_rate / method.rate) ** share
