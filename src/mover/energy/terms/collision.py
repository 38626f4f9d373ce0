r"""People move through free space (Sec. 3.1, "Collision constraint").

Evidence:  V = min(V_1, ..., V_T), the signed distance to all bodies on one grid [m]
Price:     L_collision = \sum_i \sum_u \| V(u_i) \|_2^2   where V(u_i) < 0
Paper:     the vertices u of a mesh that marching cubes made lie evenly on it, and how many they are
           is not printed: here even surface samples, whose sum counts as that of 1000, as many as
           the authors' code draws. So the resolution of a mesh has no weight.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Objects
from mover.energy.terms.contact import ContactPoints
from mover.geometry.volume import Volume, sample

SAMPLES = 1000.0  # of an object in the authors' code; 3 cm inside on each is a price of one


@record
class BodySpace:
    """The room that the people have moved through."""

    volume: Volume
    """Signed distance to the nearest body of any frame."""


def collision_term(
    points: Float[Tensor, "*starts objects points 3"], space: BodySpace
) -> Float[Tensor, "*starts objects"]:
    """Squared depth of even surface samples inside the bodies of all frames [m²]."""
    depth = sample(space.volume, points).clamp_max(0)
    return SAMPLES * depth.square().mean(-1)


def collision_share(objects: Objects, touches: ContactPoints | None) -> Float[Tensor, " objects"]:
    """Weight of the collision of each object: a tenth for a seat that is used (`robust` only).

    A body is soft and the shape of a seat is often wrong: the body of the sitter then lies inside
    the mesh, and the seat would flee.
    """
    if touches is None:
        return objects.verts.new_ones(len(objects.ids))
    used = objects.verts.new_zeros(len(objects.ids)).index_fill(0, touches.object_of, 1.0)
    return 1 - 0.9 * used * objects.is_seat.to(used)
