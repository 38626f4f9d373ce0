r"""A new term of the objective: python examples/add_a_term.py.

A wall stands behind the room, and no object stands in it:

    L_behind = \sum_i relu(z_wall - z_i)^2

where z_i is the farthest point of object i. A term takes tensors and returns one value for each
start and object; it sums over nothing else, so that starts stay independent.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.observe import Energy
from mover.core.types import Layout
from mover.energy.config import Adam
from mover.energy.minimize import minimize
from mover.energy.prior_terms import scale_term
from mover.geometry.placement import place

WALL = -4.0  # [m], z of the wall


def behind_term(
    verts: Float[Tensor, "*starts objects verts 3"], wall: float
) -> Float[Tensor, "*starts objects"]:
    """Squared depth of the objects in the wall [m²]."""
    return (wall - verts[..., 2].amin(-1)).relu().square()


def main() -> Layout:
    """Two boxes, one of them in the wall, from two starts each."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    boxes = corners.repeat(2, 1, 1)
    places = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, -3.9]]).repeat(2, 1, 1)
    start = Layout(places, torch.tensor([[0.0, 0.0], [0.7, 0.7]]), torch.zeros(2, 2, 3))

    def energy(layout: Layout) -> Energy:
        scale = scale_term(layout.log_scale, "robust")
        return Energy({"scale": scale, "behind": 10.0 * behind_term(place(boxes, layout), WALL)})

    found = minimize(energy, start, Adam(200, 0.02, 0.002), stage="two boxes")
    for name, values in energy(found.at).parts.items():
        print(name, values.tolist())
    print("farthest points [m]:", place(boxes, found.at)[..., 2].amin(-1).tolist())
    return found.at


if __name__ == "__main__":
    main()
