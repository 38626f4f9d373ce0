"""How tall people are: what is told of it, and how large a body is.

Keypoints hardly tell: a body that is a tenth taller and a tenth farther away looks the same. So
how far everybody is hangs on the height that shape and prior give, unless it is told.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, PARENTS
from mover.bodies.smpl_model import Model, heights_of
from mover.core.errors import InputError
from mover.core.records import record

UNTOLD = 0.025  # of the logarithm of a height, found without one told (rooms 100-109, 120, 122)
BONES = 4.6  # [m], the 21 bones of a usual person end to end


@record
class Stature:
    """What a body model makes of its numbers of the shape, and what is told."""

    usual: float
    """Height of the mean shape [m]."""
    dirs: Float[Tensor, " shape"]
    """What each number of the shape adds to it [m]."""
    given: Float[Tensor, " people"]
    """How tall each person is [m]; NaN: nobody told."""


def stature_of(
    model: Model,
    heights: tuple[float, ...],
    person: Int[Tensor, " bodies"],
    rows: Int[Tensor, " some"],
) -> Stature | None:
    """What is told of the heights of the people in some rows; None: nothing.

    Args:
        model: The body model.
        heights: Of each person in the order of their numbers, or one for everybody [m].
        person: Their numbers in all rows.
        rows: Those that are fitted.

    Raises:
        InputError: If there are others than there are people.
    """
    if not heights:
        return None
    everybody = person.unique()
    if len(heights) not in (1, len(everybody)):
        raise InputError(
            f"height: {len(heights)} are given, expected 1, or {len(everybody)}: one a person"
        )
    usual, dirs = heights_of(model)
    given = torch.tensor(heights).expand(len(everybody))
    fitted = torch.isin(everybody, person[rows])
    return Stature(usual, dirs, given[fitted])


def height_price(
    stature: Stature, betas: Float[Tensor, "people shape"]
) -> Float[Tensor, " people"]:
    """Squared distance from the height that is told [m²]; 0 where nobody told."""
    tall = stature.usual + betas @ stature.dirs[: betas.shape[1]].to(betas)
    off = tall - stature.given.to(betas)
    return torch.where(off.isfinite(), off, torch.zeros_like(off)).square()


def size_of(joints: Float[Tensor, "bodies joints 3"]) -> Float[Tensor, " bodies"]:
    """How large bodies are: 1 for a usual person, whatever the pose."""
    body = joints[:, : len(BODY)]
    bones = body[:, 1:] - body[:, list(PARENTS[1 : len(BODY)])]
    return bones.square().sum(-1).clamp_min(1e-12).sqrt().sum(-1) / BONES
