r"""How much longer the lens is than it was said to be: a robust line through where people are seen.

    m - c = z (b - c) + h o

m: middle of a person's mask, b: of the drawn body, c: the principal point, h: the body's height in
the image, z: true focal length over the given one, o: what masks of one person are off on average,
in body heights, because bodies are bent by mistake or outlines too wide.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..records import record

OFFSET = 0.03  # of a body's height: usual size of `o`
SYSTEMATIC = 0.002  # error of the logarithm that more frames do not make smaller
NOISE = 0.005  # of a body's height: middles are never more exact than that
TURNS = 20  # enough for the weights of the robust price to settle
GAUSS = 1.4826  # standard deviation over the median of absolute deviations


@record
class Sightings:
    """Where people are drawn and where they are seen."""

    drawn: Float[Tensor, "rows 2"]
    """Middle of each drawn body, from the principal point [px]."""
    seen: Float[Tensor, "rows 2"]
    """Middle of its mask, from the principal point [px]."""
    height: Float[Tensor, " rows"]
    """Of the drawn body [px]."""
    person: Int[Tensor, " rows"]
    moment: Int[Tensor, " rows"]
    """Rows of one person and moment err together."""


def fit_zoom(sightings: Sightings, spread: float) -> tuple[float, float]:
    """The factor z and the standard deviation of its logarithm.

    Args:
        sightings: Of all people.
        spread: Standard deviation of log z before anybody is seen. Where people say little, z
            stays near 1 and its spread near this.

    Returns:
        Maximum a posteriori under the robust price of Geman and McClure; the weight of the rows is
        divided by how much rows of one moment err together.
    """
    rows, target = _lines(sightings)
    trust = torch.full((rows.shape[1],), OFFSET**-2, dtype=torch.float64)
    trust[0] = spread**-2
    centre = torch.zeros_like(trust)
    centre[0] = 1.0
    _, group = torch.stack([sightings.person, sightings.moment], -1).unique(
        dim=0, return_inverse=True
    )
    at, shared = centre, 1.0
    weight = torch.ones(len(target), dtype=torch.float64)
    for _ in range(TURNS):
        residual = target - rows @ at
        noise = max(GAUSS * float(residual.abs().median()), NOISE)
        weight = noise**-2 / (1 + (residual / (2 * noise)).square()).square()
        shared = _together(rows[:, 0] * weight * residual, group.repeat_interleave(2))
        hessian = rows.mT @ (weight[:, None] * rows) / shared + trust.diag()
        at = torch.linalg.solve(hessian, rows.mT @ (weight * target) / shared + trust * centre)
    hessian = rows.mT @ (weight[:, None] * rows) / shared + trust.diag()
    error = float(torch.linalg.inv(hessian)[0, 0]) ** 0.5 / float(at[0])
    return float(at[0]), min((error**2 + SYSTEMATIC**2) ** 0.5, spread)


def _lines(sightings: Sightings) -> tuple[Float[Tensor, "lines unknowns"], Float[Tensor, " lines"]]:
    """One line for each row and axis, in body heights: factor, then two offsets a person."""
    height = sightings.height.double()[:, None]
    people, person = sightings.person.unique(return_inverse=True)
    own = torch.nn.functional.one_hot(person, len(people)).double()
    drawn = (sightings.drawn.double() / height).reshape(-1, 1)
    axes = torch.eye(2, dtype=torch.float64)
    offsets = (own[:, None, :, None] * axes[None, :, None, :]).reshape(len(drawn), -1)
    return torch.cat([drawn, offsets], 1), (sightings.seen.double() / height).reshape(-1)


def _together(pull: Float[Tensor, " lines"], group: Int[Tensor, " lines"]) -> float:
    """Variance of the sum of pulls over what it would be if none erred with another; at least 1."""
    each = float(pull.square().sum())
    sums = torch.zeros(int(group.max()) + 1, dtype=pull.dtype).index_add(0, group, pull)
    return max(1.0, float(sums.square().sum()) / each) if each > 0 else 1.0
