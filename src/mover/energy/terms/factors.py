"""How much depth order and collision count for seats that are used (not in the paper)."""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.devices import constant
from mover.core.records import record
from mover.core.types import Objects
from mover.energy.config import Variant
from mover.energy.terms.contact import ContactPoints

CHAIRS = ("chair", "armchair", "office chair", "stool")  # one class in the authors' detector


@record
class Factors:
    """How much depth order and collision count for each object."""

    depth: Float[Tensor, " objects"]
    collision: Float[Tensor, " objects"]


def factors(objects: Objects, touches: ContactPoints | None, form: Variant) -> Factors:
    """Weigh down evidence that pushes used seats away from their sitters.

    A body is soft and a seat's shape is often wrong: the sitter's body then lies inside the mesh
    and the seat would flee. Release: depth x 0.3 (chair) and x 0.01 (sofa), collision x 0.1
    (chair); it takes twice as many samples from a sofa. Robust: collision x 0.1 for every seat.
    Paper: no factor.
    """
    depth, collision = objects.verts.new_ones(2, len(objects.ids)).unbind()

    def is_one_of(*names: str) -> Tensor:
        return constant(tuple(c in names for c in objects.categories), depth)

    if form == "release":
        collision = 1 + is_one_of("sofa")
    if touches is None or form == "paper":
        return Factors(depth, collision)
    used = torch.zeros_like(depth).index_fill(0, touches.object_of, 1.0)
    if form == "release":
        chairs = used * is_one_of(*CHAIRS)
        depth = 1 - 0.7 * chairs - 0.99 * used * is_one_of("sofa")
        return Factors(depth, collision * (1 - 0.9 * chairs))
    return Factors(depth, 1 - 0.9 * used * objects.is_seat.to(used))
