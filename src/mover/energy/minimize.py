"""Objectives as named terms, robust losses, and gradient descent on a record of tensors."""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
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
    needs: tuple[str, ...] = ()
    """Names of the evidence without which it says nothing."""
    fused: bool = False
    """Whether the fused kernel has it (`robust`)."""
    bare: bool = False
    """Whether it looks at nothing but the layout, the boxes and its own evidence of the image."""


def active_weights(weights: W, terms: Iterable[Term[S]], has: Callable[[str], bool]) -> W:
    """The weights without those whose evidence is missing."""
    missing = {t.name: 0.0 for t in terms if not all(map(has, t.needs))}
    return dataclasses.replace(weights, **missing)


def sum_terms(weights: object, terms: Iterable[Term[S]], state: S) -> Energy:
    """Sum terms; one with weight zero is neither computed nor needs its evidence."""
    each = ((term, getattr(weights, term.name)) for term in terms)
    return Energy({term.name: weight * term.cost(state) for term, weight in each if weight != 0.0})


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
    """Follow the gradient of `energy` from `start`, by Adam.

    Every field of `P` is a tensor; with `keep_best` its leading axes are those of the items.

    Raises:
        ValueError: If the energy stops being finite.
    """
    names = [f.name for f in dataclasses.fields(start)]  # type: ignore[arg-type]
    fields = [getattr(start, name).detach() for name in names]
    at = torch.cat([x.flatten() for x in fields])  # all unknowns in one tensor; leaves share it
    parts = at.split([x.numel() for x in fields])
    leaves = [
        part.view(x.shape).detach().requires_grad_() for part, x in zip(parts, fields, strict=True)
    ]
    free: P = dataclasses.replace(start, **dict(zip(names, leaves, strict=True)))  # type: ignore[type-var]
    mean, square, trace = torch.zeros_like(at), torch.zeros_like(at), list[Tensor]()
    best: tuple[Tensor, Tensor] | None = None
    for index in range(method.steps):
        value = energy(free)
        slopes = torch.autograd.grad(value.total, leaves, materialize_grads=True)
        slope, items = torch.cat([x.flatten() for x in slopes]), value.per_item.detach()
        best = _lower(best, items, at, fields) if method.keep_best else None
        trace.append(items.sum())
        share = index / max(1, method.steps - 1)
        rate = method.rate * (method.last_rate / method.rate) ** share
        mean.lerp_(slope, 1 - BETA1)
        square.mul_(method.beta2).addcmul_(slope, slope, value=1 - method.beta2)
        length = (square.sqrt() / (1 - method.beta2 ** (index + 1)) ** 0.5).add_(1e-8)
        at.add_((mean * (-rate / (1 - BETA1 ** (index + 1)))).div_(length))
        observe(Step(stage, index, method.steps, value))
    with torch.no_grad():
        last = energy(free).per_item
    best = _lower(best, last, at, fields) if method.keep_best else None
    totals = torch.stack([*trace, last.sum()])
    if not bool(totals.isfinite().all()):
        raise ValueError(f"{stage}: the energy is not finite")
    if best is not None:
        last = best[0]
        at.copy_(best[1])
    return Minimum(map_tensors(lambda x: x.detach().clone(), free), last, totals[:-1])


def _lower(
    best: tuple[Tensor, Tensor] | None, items: Tensor, at: Tensor, fields: list[Tensor]
) -> tuple[Tensor, Tensor]:
    """The lowest energy of each item so far, and the unknowns of all items there."""
    if best is None:
        return items.clone(), at.clone()
    wins = items < best[0]
    owners = [
        wins.reshape(items.shape + (1,) * (x.ndim - items.ndim)).expand(x.shape) for x in fields
    ]
    there = torch.where(torch.cat([x.flatten() for x in owners]), at, best[1])
    return torch.where(wins, items, best[0]), there
