r"""Second-order descent of many small problems at once: each steps, judges and stops on its own.

A problem keeps a model of its energy, E + g.s + s.B.s / 2, and steps to the model's minimum within
the radius in which it trusts the model (Conn, Gould, Toint: Trust-Region Methods, 2000, Sec. 7.3).
B learns from pairs of gradients by Powell's damped BFGS update (Nocedal, Wright: Numerical
Optimization, 2006, Procedure 18.2), also from steps that were refused. A step is taken only if it
lowers the energy; a problem whose energy or radius no longer changes leaves the batch.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Generic, TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from mover.core.observe import Energy, Observer, Step, silent
from mover.energy.config import BatchedBFGS
from mover.energy.minimize import Minimum

P = TypeVar("P")
Rows = Int[Tensor, " few"]
GOOD, BAD = 0.75, 0.25  # share of the promised decrease from which a radius grows, shrinks
DAMPED = 0.2  # least curvature that is learned, as a share of the model's
FLOOR = 1e-3  # energy below which decreases count as shares of this
SECULAR = 12  # Newton's steps to the multiplier of a step as long as the radius


@dataclass(frozen=True)
class Problems(Generic[P]):
    """Many small problems; every field of `P` is a tensor whose first axes count them."""

    of: Callable[[Rows], Callable[[P], Energy]]
    """Energy of some, by their numbers in the flattened axes; its `P` has one such axis."""
    start: P
    axes: tuple[int, ...]
    """Lengths of those first axes."""
    group: Int[Tensor, " items"] | None = None
    """Problems with one number share a decision, because one's unknowns enter another's energy."""
    like: Int[Tensor, " items"] | None = None
    """The problem that each is the same as, maybe itself: that one alone is solved."""


@dataclass(frozen=True)
class _Live:
    """The problems that still move; rows are problems, columns unknowns."""

    index: Tensor
    at: Tensor
    value: Tensor
    slope: Tensor
    model: Tensor
    """B, (problems, unknowns, unknowns)."""
    radius: Tensor
    idle: Tensor
    """Steps in a row without gain."""

    def only(self, stay: Tensor) -> "_Live":
        """Some of them; the same record where all stay."""
        if bool(stay.all()):
            return self
        return _Live(*(getattr(self, f.name)[stay] for f in dataclasses.fields(self)))


Evaluate = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def _evaluation(problems: Problems[P]) -> Evaluate:
    """Energy and gradient of rows by number; the last energy function is kept."""
    start, axes = problems.start, len(problems.axes)
    held: list[tuple[Tensor, Callable[[P], Energy]]] = []

    def evaluate(index: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
        if not held or not torch.equal(held[0][0], index):
            held[:] = [(index, problems.of(index))]
        free = at.clone().requires_grad_()
        value = held[0][1](_shaped(free, start, (len(index),), axes)).per_item
        (slope,) = torch.autograd.grad(value.sum(), free)
        return value.detach().double(), slope

    return evaluate


def minimize_batched(
    problems: Problems[P], method: BatchedBFGS, observe: Observer = silent, stage: str = ""
) -> Minimum[P]:
    """Lower the energy of each problem from its start until all have converged.

    The result is never higher than the start, does not depend on what else is in the batch, and is
    the same for every run on a CPU.

    Raises:
        ValueError: If an energy is not finite at the start.
    """
    start, axes, evaluate = problems.start, problems.axes, _evaluation(problems)
    dtype, ends = getattr(start, _names(start)[0]).dtype, _flat(start, len(axes))
    like = torch.arange(prod(axes)).to(ends.device) if problems.like is None else problems.like
    solved = like.unique()
    value, slope = evaluate(solved, ends[solved])
    radius = torch.full_like(value, method.reach)
    round_ = (slope.norm(dim=-1) / radius)[:, None, None] * torch.eye(slope.shape[1]).to(slope)
    idle = torch.zeros_like(solved)
    live = _Live(solved, ends[solved], value, slope, round_, radius, idle)
    values = torch.zeros_like(ends[:, 0])
    values[live.index] = live.value
    trace = [values[like].sum()]
    if not bool(live.value.isfinite().all() and live.slope.isfinite().all()):
        raise ValueError(f"{stage}: the energy is not finite")

    def report(index: int) -> None:
        seen = Energy({"energy": values[like].reshape(axes)})
        observe(Step(stage, index, method.steps, seen))

    live = live.only(_pooled(problems, live, live.slope.norm(dim=-1)) > 0)
    for index in range(method.steps):
        if not len(live.index):
            break
        live = _advance(problems, evaluate, live, method)
        ends[live.index], values[live.index] = live.at, live.value
        trace.append(values[like].sum())
        report(index)
        moves = (live.idle < method.patience) & (live.radius > method.least)
        live = live.only(_pooled(problems, live, moves.double()) > 0)
    if method.steps:
        report(method.steps - 1)
    found = _shaped(ends[like], start, axes, len(axes))
    return Minimum(found, values[like].to(dtype).reshape(axes), torch.stack(trace).to(dtype))


def _advance(problems: Problems[P], evaluate: Evaluate, live: _Live, method: BatchedBFGS) -> _Live:
    """One step of each problem, taken or refused."""
    step, promise = _step(live.model, live.slope, live.radius)
    value, slope = evaluate(live.index, live.at + step)
    before, gain = (_pooled(problems, live, x) for x in (live.value, live.value - value))
    share = gain / _pooled(problems, live, promise).clamp_min(1e-300)
    known = slope.isfinite().all(-1)
    taken = (gain > 0) & known  # not so where the energy is not finite
    small = gain <= method.gain * before.abs().clamp_min(FLOOR)
    learned = _learned(live.model, step, slope - live.slope)
    length = step.norm(dim=-1)
    grown = torch.where((share > GOOD) & (length > 0.9 * live.radius), 2.0, 1.0) * live.radius
    radius = torch.where(share >= BAD, grown.clamp_max(method.widest), 0.5 * length)
    return _Live(
        live.index,
        torch.where(taken[:, None], live.at + step, live.at),
        torch.where(taken, value, live.value),
        torch.where(taken[:, None], slope, live.slope),
        torch.where(known[:, None, None], learned, live.model),
        radius,
        torch.where(taken, torch.where(small, live.idle + 1, 0), live.idle),
    )


def _step(model: Tensor, slope: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """Minimum of the model within the radius, and the decrease that it promises."""
    curve, axes = torch.linalg.eigh(model)
    curve = curve.clamp_min(1e-12)  # the update keeps them positive but for rounding
    along = (axes * slope.unsqueeze(-1)).sum(-2)
    reach, square = radius.unsqueeze(-1), along.square()
    damping = torch.zeros_like(reach)
    for _ in range(SECULAR):  # Nocedal, Wright, Algorithm 4.3: from below, never too far
        damped = curve + damping
        part = square / damped.square()
        length = part.sum(-1, keepdim=True).sqrt()
        bend = (part / damped).sum(-1, keepdim=True).clamp_min(1e-300)
        more = (length - reach) / reach * (length.square() / bend)
        damping = (damping + more).clamp_min(0)
    move = -along / (curve + damping)
    move = move * (reach / move.norm(dim=-1, keepdim=True).clamp_min(1e-300)).clamp_max(1)
    promise = -(along * move + 0.5 * curve * move.square()).sum(-1)
    return (axes * move.unsqueeze(-2)).sum(-1), promise


def _learned(model: Tensor, step: Tensor, change: Tensor) -> Tensor:
    """The model with the gradient's change along a step, damped so that it stays convex."""
    push = (model * step.unsqueeze(-2)).sum(-1)
    curve, seen = (step * push).sum(-1), (step * change).sum(-1)
    short = seen < DAMPED * curve
    part = torch.where(short, (1 - DAMPED) * curve / (curve - seen).clamp_min(1e-300), 1.0)
    change = part.unsqueeze(-1) * change + (1 - part).unsqueeze(-1) * push
    seen = (step * change).sum(-1)
    usable = (curve > 1e-300) & (seen > 1e-300)
    old, new = (torch.where(usable, x, torch.inf)[:, None, None] for x in (curve, seen))
    outer = push[:, :, None] * push[:, None, :] / old
    return model - outer + change[:, :, None] * change[:, None, :] / new


def _pooled(problems: Problems[P], live: _Live, x: Tensor) -> Tensor:
    """The sum over each row's group."""
    if problems.group is None:
        return x
    names, row = problems.group[live.index].unique(return_inverse=True)
    return x.new_zeros(len(names)).index_add(0, row, x)[row]


def _names(record: object) -> list[str]:
    return [field.name for field in dataclasses.fields(record)]  # type: ignore[arg-type]


def _flat(start: object, axes: int) -> Tensor:
    """Rows of unknowns, in double precision."""
    fields = [getattr(start, name).detach() for name in _names(start)]
    n = prod(fields[0].shape[:axes])
    return torch.cat([x.reshape(n, prod(x.shape[axes:])) for x in fields], 1).double()


def _shaped(rows: Tensor, like: P, lead: tuple[int, ...], axes: int) -> P:
    """The inverse of `_flat`, with other first axes."""
    old = {name: getattr(like, name) for name in _names(like)}
    parts = rows.split([prod(x.shape[axes:]) for x in old.values()], 1)
    fields = {
        name: part.to(x.dtype).reshape(*lead, *x.shape[axes:])
        for (name, x), part in zip(old.items(), parts, strict=True)
    }
    return dataclasses.replace(like, **fields)  # type: ignore[type-var]
