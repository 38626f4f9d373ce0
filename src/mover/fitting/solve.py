"""L-BFGS over all frames at once."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..minimize import Energy
from .unknowns import Unknowns, to_values, with_values

EVERYTHING = ("turn", "code", "place", "betas", "hands", "face")


def solve(
    energy: Callable[[Unknowns], Energy],
    start: Unknowns,
    steps: int,
    free: tuple[str, ...] = EVERYTHING,
) -> Unknowns:
    """Lower the energy in the fields `free`.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = to_values(start, free)
    return with_values(start, lowered(lambda v: energy(with_values(start, v)), values, steps))


def lowered(
    energy: Callable[[dict[str, Tensor]], Energy], start: dict[str, Tensor], steps: int
) -> dict[str, Tensor]:
    """Lower an energy of named tensors by L-BFGS with a strong Wolfe line search.

    Raises:
        ValueError: If the energy is not finite at the start.
    """
    values = {n: v.detach().clone().requires_grad_() for n, v in start.items()}
    solver = torch.optim.LBFGS(
        list(values.values()), max_iter=steps, max_eval=2 * steps, history_size=20,
        tolerance_grad=1e-6, tolerance_change=1e-9, line_search_fn="strong_wolfe",
    )  # fmt: skip

    def closure() -> Float[Tensor, ""]:
        solver.zero_grad()
        value = energy(values).total
        torch.autograd.backward(value)
        return value

    first = solver.step(closure)  # pyright: ignore[reportArgumentType]
    if not bool(torch.as_tensor(first).isfinite()):
        raise ValueError("the energy of the bodies is not finite")
    return {n: v.detach() for n, v in values.items()}
