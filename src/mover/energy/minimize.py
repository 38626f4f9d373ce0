"""Objectives as named terms, robust losses, and gradient descent on a record of tensors."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.observe import Energy, Observer, PerItem, Step, silent
from mover.core.records import map_tensors
from mover.energy.config import Adam, BodyWeights, SceneWeights

P = TypeVar("P")
S = TypeVar("S")
W = TypeVar("W", SceneWeights, BodyWeights)
BETA1 = 0.9  # memory of the gradient


def geman_mcclure(residual: Float[Tensor, "*any"], rho: float) -> Float[Tensor, "*any"]:
    """Robust cost r^2 / (r^2 + rho^2) in [0, 1); one half where |r| = rho."""
    squared = residual.square()
    return squared / (squared + rho**2)


def safe_norm(x: Float[Tensor, "*any axis"], eps: float = 1e-12) -> Float[Tensor, "*any"]:
    """Length of the last axis with a finite gradient at zero."""
    return (x.square().sum(-1) + eps).sqrt() - eps**0.5


@dataclass(frozen=True)
class Term(Generic[S]):
    """A row of an objective."""

    name: str
    """The field of the weights."""
    cost: Callable[[S], PerItem]
    """What a state costs, before its weight."""
    word: str
    """What it is to people, after "held by" and "without"."""
    needs: tuple[str, ...] = ()
    """Names of the evidence without which it says nothing."""
    fused: bool = False
    """Whether the fused kernel has it (`robust`)."""
    bare: bool = False
    """Whether it looks at nothing but the layout, the boxes and its own evidence of the image."""


def active_weights(weights: W, terms: Iterable[Term[S]], has: Callable[[str], bool]) -> W:
    """The weights without those whose evidence is missing.

    Args:
        weights: A dataclass of numbers.
        terms: The objective.
        has: Whether the evidence of a name is there.
    """
    missing = {t.name: 0.0 for t in terms if not all(map(has, t.needs))}
    return dataclasses.replace(weights, **missing)


def weigh(*terms: tuple[str, float, Callable[[], PerItem]]) -> Energy:
    """Sum named terms; one with weight zero is neither computed nor needs its evidence."""
    return Energy({name: weight * term() for name, weight, term in terms if weight != 0.0})


def sum_terms(weights: object, terms: Iterable[Term[S]], state: S) -> Energy:
    """The same for rows of an objective."""
    return weigh(*((t.name, getattr(weights, t.name), partial(t.cost, state)) for t in terms))


def there(evidence: S | None) -> S:
    """Evidence of a term whose weight is not zero (see `active_weights`)."""
    assert evidence is not None
    return evidence


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

    Args:
        energy: What to minimise.
        start: From where.
        method: How.
        observe: Receives every step.
        stage: Name for observers and error messages.

    Raises:
        ValueError: If the energy stops being finite.
    """
    free = _FreeTensors(start, method)
    for index in range(method.steps):
        value = free.step(energy)
        observe(Step(stage, index, method.steps, value, lambda: free.record))
    with torch.no_grad():
        last = energy(free.record).per_item
        free.note(last)
        if not torch.cat([free.trace, last.sum().view(1)]).isfinite().all():
            raise ValueError(f"{stage}: the energy is not finite")
        if method.keep_best:
            last = free.lowest
            free.at.copy_(free.best)
    at = map_tensors(lambda x: x.detach().clone(), free.record)
    return Minimum(at, last, free.trace)


class _FreeTensors(Generic[P]):
    """All fields of a record in one tensor, and all that a step reads and changes."""

    trace: Tensor
    """Total energy before each step."""
    lowest: Tensor
    """Lowest energy of each item so far (`keep_best`)."""
    owner: Tensor
    """Number of the item that each unknown belongs to (`keep_best`)."""

    def __init__(self, start: P, method: Adam) -> None:
        names = [f.name for f in dataclasses.fields(start)]  # type: ignore[arg-type]
        fields = [getattr(start, n).detach() for n in names]
        self.at = torch.cat([x.flatten() for x in fields])
        self.best = self.at.clone()
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
        self.method, self.noted = method, False
        self.table = torch.tensor(_table(method)).to(self.at)
        self.index = torch.zeros(1, dtype=torch.int64, device=self.at.device)

    def step(self, energy: Callable[[P], Energy]) -> Energy:
        """One step down, and the energy before it."""
        self.slope.zero_()
        value = energy(self.record)
        value.total.backward()
        with torch.no_grad():
            items = value.per_item.detach()
            self.note(items)
            self.trace.index_copy_(0, self.index, items.sum().view(1))
            self.move()
            self.index.add_(1)
        return value

    def move(self) -> None:
        """Adam's step, in the operations of `torch.optim.Adam`."""
        beta2, grad = self.method.beta2, self.slope
        spread, rate = self.table.index_select(0, self.index)[0].unbind()
        self.mean.lerp_(grad, 1 - BETA1)
        self.square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
        length = (self.square.sqrt() / spread).add_(1e-8)
        self.at.add_((self.mean * rate).div_(length))

    def note(self, items: Tensor) -> None:
        """Keep, item by item, the state with the lowest energy so far, and that energy."""
        if not self.noted:
            self._begin(items)
        if self.method.keep_best:
            wins = items < self.lowest
            torch.where(wins.flatten()[self.owner], self.at, self.best, out=self.best)
            torch.where(wins, items, self.lowest, out=self.lowest)

    def _begin(self, items: Tensor) -> None:
        """Room for what is known of each item, once it is known how many there are."""
        self.noted, self.trace = True, items.new_zeros(self.method.steps)
        if not self.method.keep_best:
            return
        self.lowest = torch.full_like(items, torch.inf)
        number = torch.arange(items.numel(), device=items.device).view(items.shape)
        parts = [
            number.reshape(items.shape + (1,) * (len(shape) - items.ndim)).expand(shape)
            for shape in self.shapes
        ]
        self.owner = torch.cat([x.flatten() for x in parts])


def _table(method: Adam) -> list[tuple[float, float]]:
    """By what the root of the squares is divided, and how far to go, at each step."""
    return [
        (
            (1 - method.beta2 ** (index + 1)) ** 0.5,
            -_rate(method, index) / (1 - BETA1 ** (index + 1)),
        )
        for index in range(method.steps)
    ]


def _rate(method: Adam, index: int) -> float:
    share = index / max(1, method.steps - 1)
    return method.rate * (method.last_rate / method.rate) ** share
