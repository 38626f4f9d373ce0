r"""Objects stay at the distance they were given, where nothing else tells it (not in the paper).

Price:     L_distance = \sum_i \rho(\log \| t_i \| / \| t_i^{init} \|)
Robust:    Geman and McClure, half of it at a tenth of the distance.

A tall piece whose base is hidden and that nobody touches is held in depth by its size alone: then a
border of a mask that is one pixel too wide moves it by a metre at no price. The bound is low, so
that this term has no say where a base is seen or a person tells more, however wrong the start is.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.types import Layout
from mover.energy.minimize import geman_mcclure

RHO = 0.1  # of the distance


def distance_term(
    layout: Layout, given: Float[Tensor, " objects"]
) -> Float[Tensor, "*starts objects"]:
    """Price of another distance from the camera than the given one [1]."""
    away = layout.t_world_object.square().sum(-1).clamp_min(1e-6).log() / 2
    return geman_mcclure(away - given.clamp_min(1e-3).log(), RHO)
