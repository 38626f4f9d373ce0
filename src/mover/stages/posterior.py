"""Normal distributions over the few unknowns that a whole room shares: tilt, height, scale.

Each source of knowledge is an observation with its covariance. Errors that observations share are
unknowns of their own, so that ten observations which err together count as one.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record

FREEDOM = 3.0  # degrees of freedom of Student's t, for observations that may be plainly wrong
ROUNDS = 30  # of reweighting; it converges in about ten


@record
class Gaussian:
    """A normal distribution."""

    mean: Float[Tensor, " unknowns"]
    precision: Float[Tensor, "unknowns unknowns"]
    """Inverse covariance; singular where something is not constrained."""

    @property
    def covariance(self) -> Float[Tensor, "unknowns unknowns"]:
        """Inverse of the precision."""
        return torch.linalg.inv(self.precision)

    def times(self, other: "Gaussian") -> "Gaussian":
        """What both know together, if they err independently."""
        precision = self.precision + other.precision
        both = self.precision @ self.mean + other.precision @ other.mean
        return Gaussian(torch.linalg.solve(precision, both), precision)


def diagonal(mean: Float[Tensor, " unknowns"], spread: Float[Tensor, " unknowns"]) -> Gaussian:
    """Independent unknowns by their standard deviations; infinite: nothing is known."""
    return Gaussian(mean, spread.square().reciprocal().diag())


class Observations:
    """Rows of a least-squares problem: observed = slopes . unknowns + an error of known spread."""

    def __init__(self) -> None:
        self.slopes: list[Tensor] = []
        self.values: list[Tensor] = []
        self.spreads: list[Tensor] = []
        self.robust: list[Tensor] = []

    def add(
        self,
        slopes: Float[Tensor, "*rows unknowns"],
        values: Float[Tensor, "*rows"] | float,
        spreads: Float[Tensor, "*rows"] | float,
        robust: bool = False,
    ) -> None:
        """Observe values with errors of such standard deviations, linear in the unknowns.

        With `robust` errors have Student's distribution, as some are plainly wrong.
        """
        shape = slopes.shape[:-1]
        for rows, value in ((self.values, values), (self.spreads, spreads), (self.robust, robust)):
            rows.append(torch.as_tensor(value).to(slopes.device).expand(shape).reshape(-1))
        self.slopes.append(slopes.reshape(-1, slopes.shape[-1]))


def least_squares(seen: Observations) -> Gaussian:
    """The unknowns by all observations at once, those of Student's errors reweighted."""
    slopes, robust = torch.cat(seen.slopes), torch.cat(seen.robust)
    values, spreads = (
        torch.cat([x.double() for x in rows]) for rows in (seen.values, seen.spreads)
    )
    found: Gaussian | None = None
    weight = spreads.square().reciprocal()
    for _ in range(ROUNDS):
        precision = slopes.mT @ (weight[:, None] * slopes)
        found = Gaussian(torch.linalg.solve(precision, slopes.mT @ (weight * values)), precision)
        off = ((values - slopes @ found.mean) / spreads).square()
        student = (FREEDOM + 1) / (FREEDOM + off)
        weight = torch.where(robust, student.clamp_max(1.0), 1.0) / spreads.square()
    assert found is not None
    return found
