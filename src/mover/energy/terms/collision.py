r"""People move through free space (Sec. 3.1, "Collision constraint").

Evidence:  V = min(V_1, ..., V_T), the signed distance to all bodies on one grid [m]
Price:     L_collision = \sum_i \sum_u \| V(u_i) \|_2^2   where V(u_i) < 0
Paper:     the vertices u of a mesh that marching cubes made lie evenly on it, and how many they are
           is not printed: here even surface samples, whose sum counts as that of 1000, as many as
           the release draws. So the resolution of a mesh has no weight.
Release:   the same samples (twice as many of sofas, see `factors`), and the price is |V|.
Robust:    as in the paper.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.energy.config import Variant
from mover.geometry.volume import Volume, sample

SAMPLES = 1000.0  # of an object in the release; 3 cm inside on each is a price of one


@record
class BodySpace:
    """The room that the people have moved through."""

    volume: Volume
    """Signed distance to the nearest body of any frame."""


def collision_term(
    points: Float[Tensor, "*starts objects points 3"], space: BodySpace, form: Variant
) -> Float[Tensor, "*starts objects"]:
    """Price of even surface samples inside the bodies of all frames; `release` [m], else [m²]."""
    depth = sample(space.volume, points).clamp_max(0)
    if form == "release":
        return -depth.mean(-1) * SAMPLES
    return SAMPLES * depth.square().mean(-1)
