r"""Feet at rest stand on the ground (Sec. 3.2, "Initialization of the ground and camera").

Evidence:  C^feet, points under the still, load-bearing soles of all frames, in camera axes
Price:     L_feet = rho(R^T C^feet - [0, y_gp, 0]^T; sigma_1), rho Geman-McClure, sigma_1 = 0.1 m
Reading:   As printed, rho would act on the sum of all points, and on x and z as well, which no
           floor bounds. Here rho acts on each point, as in the authors' code, and only on
           its height.
Departure: Each person may float or sink by one offset, which absorbs a wrong depth of the body; a
           weak prior keeps the tilt that the feet cannot tell where the first guess had it.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.minimize import geman_mcclure

TAIL = 2.0  # degrees of freedom of the tilt's prior: small changes are squared, large ones forgiven


@record
class FootContacts:
    """Points under the feet that carry the people, from all frames."""

    points_cam: Float[Tensor, "soles 3"]
    """Places in camera axes [m]."""
    person: Int[Tensor, " soles"]
    """Track of each point."""
    frame: Int[Tensor, " soles"]
    """Frame of each point."""
    warnings: tuple[str, ...]
    """What made the evidence weaker than it should be."""
    lift: Float[Tensor, " soles"] | None = None
    """How much higher than the plane each may be as well, as a platform is seen there [m]."""


def up_cam(
    pitch: Float[Tensor, "*starts"], roll: Float[Tensor, "*starts"]
) -> Float[Tensor, "*starts 3"]:
    """The world's up-vector in the axes of a camera with this pitch and roll [rad]."""
    return torch.stack([-pitch.cos() * roll.sin(), -pitch.cos() * roll.cos(), pitch.sin()], -1)


def heights(
    points_cam: Float[Tensor, "soles 3"],
    R_cam_world: Float[Tensor, "*starts 3 3"],
    ground: Float[Tensor, "*starts"],
) -> Float[Tensor, "*starts soles"]:
    """Height of points above the ground, the residual of L_feet [m]."""
    return R_cam_world[..., :, 1] @ points_cam.mT - ground.unsqueeze(-1)


def over_floor(
    soles: FootContacts,
    R_cam_world: Float[Tensor, "*starts 3 3"],
    ground: Float[Tensor, "*starts"],
    offset: Float[Tensor, " soles"],
) -> Float[Tensor, "*starts soles"]:
    """Height of sole points above what is nearer, the plane or their platform [m].

    The offset is how far each point's person floats [m].
    """
    high = heights(soles.points_cam, R_cam_world, ground) - offset
    if soles.lift is None:
        return high
    return torch.where((high - soles.lift).abs() < high.abs(), high - soles.lift, high)


def feet_term(
    soles: FootContacts,
    R_cam_world: Float[Tensor, "*starts 3 3"],
    ground: Float[Tensor, "*starts"],
    offset: Float[Tensor, " soles"],
    rho: float,
) -> Float[Tensor, "*starts soles"]:
    """Price of each sole point that is not on the ground, in [0, 1); one half at `rho` [m].

    The offset is how far each point's person floats above the floor [m].
    """
    return geman_mcclure(over_floor(soles, R_cam_world, ground, offset), rho)


def tilt_prior(
    pitch: Float[Tensor, "*starts"],
    roll: Float[Tensor, "*starts"],
    first: Float[Tensor, "2"],
    spread: float,
) -> Float[Tensor, "*starts"]:
    """Price of leaving the first guess of pitch and roll, in nats.

    Half the squared change over `spread` where it is small; it grows only as a logarithm, because a
    guess is either a few degrees off or no guess at all (a camera that is said to be level).

    Args:
        pitch: Pitch [rad].
        roll: Roll [rad].
        first: Their first guess [rad].
        spread: How far off a guess usually is [rad].
    """
    squared = ((pitch - first[0]).square() + (roll - first[1]).square()) / spread**2
    return 0.5 * TAIL * (1 + squared / TAIL).log()
