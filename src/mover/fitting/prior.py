"""Priors of the pose: joint limits, a pose to stay near to, or a learned code."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from mover.core.observe import Energy
from mover.fitting.unknowns import lowered
from mover.geometry.rotations import axis_angle

Decode = Callable[[Float[Tensor, "bodies code"]], Float[Tensor, "bodies angles"]]
ENCODING_STEPS = 100


@dataclass(frozen=True)
class PosePrior:
    """How a code becomes the angles of a body."""

    decode: Decode
    """From codes to angles [rad]."""
    width: int
    """Numbers of a code; 0: the code is the angles themselves."""


def same(code: Float[Tensor, "bodies code"]) -> Float[Tensor, "bodies code"]:
    """Angles that are their own code."""
    return code


ANGLES = PosePrior(same, 0)
"""No learned prior: ranges of motion, a resting pose, and the pose to start from."""


def encoded(
    prior: PosePrior, angles: Float[Tensor, "bodies angles"]
) -> Float[Tensor, "bodies code"]:
    """Codes whose bodies turn their joints as these angles do, as far as the prior can."""
    if not prior.width:
        return angles
    goal = axis_angle(angles.unflatten(-1, (-1, 3)))

    def energy(values: dict[str, Tensor]) -> Energy:
        turns = axis_angle(prior.decode(values["code"]).unflatten(-1, (-1, 3)))
        miss = (turns - goal[:, : turns.shape[1]]).square().flatten(1).sum(-1)
        return Energy({"turns": miss, "size": 3e-4 * values["code"].square().sum(-1)})

    start = {"code": angles.new_zeros(len(angles), prior.width)}
    return lowered(energy, start, ENCODING_STEPS)["code"]
