r"""People move through free space (Sec. 3.1, "Collision constraint").

Evidence:  V = min(V_1, ..., V_T), the signed distance to all bodies on one grid [m]
Price:     L_collision = \sum_i \sum_u \| V(u_i) \|_2^2   where V(u_i) < 0
Paper:     u runs over the vertices of the mesh.
Release:   u runs over even surface samples, and the price is |V| (energy.py doubles sofas).
Robust:    1000 times the mean of V^2 over even surface samples: neither the resolution of the mesh
           nor the number of samples has a weight.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.energy.config import Variant
from mover.geometry.volume import Volume, sample

SAMPLES = 1000  # surface samples of an object in the release
ROBUST = 1000.0  # brings a depth of 3 cm on every sample to a price of one


@record
class BodySpace:
    """The room that the people have moved through."""

    volume: Volume
    """Signed distance to the nearest body of any frame."""


def collision_term(
    points: Float[Tensor, "*starts objects points 3"], space: BodySpace, form: Variant
) -> Float[Tensor, "*starts objects"]:
    """Price of object points inside bodies.

    Args:
        points: Vertices (`paper`) or even surface samples [m].
        space: The bodies of all frames.
        form: `paper` [m²], `release` [m], `robust` [1].
    """
    depth = sample(space.volume, points).clamp_max(0)
    if form == "release":
        return -depth.mean(-1) * SAMPLES
    if form == "robust":
        return ROBUST * depth.square().mean(-1)
    return depth.square().sum(-1)
