"""How tall people are: the prior of their stature, and the size of a body.

Keypoints hardly constrain it: a body that is a tenth taller and a tenth farther away has the same
projection, and the proportions of a detector's joints are not those of a body model. So distances
rest on the prior of the stature: that of adults of unknown sex, or a given height.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, PARENTS
from mover.bodies.smpl_model import Model, heights_of
from mover.core.errors import InputError
from mover.core.records import record

ADULT, ADULTS = 1.68, 0.10  # [m], mean and spread of adults of either sex (NCD-RisC 2016)
UNKNOWN = ADULTS / ADULT  # standard deviation of the logarithm of an unknown height
BONES = 4.6  # [m], the 21 bones of a usual person end to end


@record
class Stature:
    """Stature as a linear function of the shape coefficients, and the given heights."""

    usual: float
    """Height of the mean shape [m]."""
    dirs: Float[Tensor, " shape"]
    """What each number of the shape adds to it [m]."""
    given: Float[Tensor, " people"]
    """Height of each person [m]; NaN: unknown."""


def stature_of(
    model: Model,
    heights: tuple[float, ...],
    person: Int[Tensor, " bodies"],
    rows: Int[Tensor, " some"],
) -> Stature:
    """The prior of the heights of the people in some rows.

    Args:
        model: The body model.
        heights: Of each person in the order of their numbers, or one for everybody [m].
        person: Their numbers in all rows.
        rows: Those that are fitted.

    Raises:
        InputError: If there are others than there are people.
    """
    everybody = person.unique()
    heights = heights or (math.nan,)
    if len(heights) not in (1, len(everybody)):
        raise InputError(
            f"height: {len(heights)} are given, expected 1, or {len(everybody)}: one a person"
        )
    usual, dirs = heights_of(model)
    given = torch.tensor(heights).expand(len(everybody))
    fitted = torch.isin(everybody, person[rows])
    return Stature(usual, dirs, given[fitted])


def height_cost(stature: Stature, betas: Float[Tensor, "people shape"]) -> Float[Tensor, " people"]:
    """Squared distance from the given height [m²]; 0 where none is given."""
    off = heights_under(stature, betas) - stature.given.to(betas)
    return torch.where(off.isfinite(), off, torch.zeros_like(off)).square()


def shape_cost(stature: Stature, betas: Float[Tensor, "people shape"]) -> Float[Tensor, " people"]:
    """Squared standard deviations from the population: of proportions, and of an unknown height.

    Proportions are the shape coefficients without their part along the gradient of the height.
    """
    dirs = stature.dirs[: betas.shape[1]].to(betas)
    along = betas @ dirs / dirs.norm()
    off = (heights_under(stature, betas) - ADULT) / ADULTS
    unknown = stature.given.isnan().to(betas.device)
    rest = (betas.square().sum(-1) - along.square()).clamp_min(0)
    return rest + torch.where(unknown, off, torch.zeros_like(off)).square()


def heights_under(
    stature: Stature, betas: Float[Tensor, "people shape"]
) -> Float[Tensor, " people"]:
    """Height of each person [m]."""
    return stature.usual + betas @ stature.dirs[: betas.shape[1]].to(betas)


def size_of(joints: Float[Tensor, "bodies joints 3"]) -> Float[Tensor, " bodies"]:
    """How large bodies are: 1 for a usual person, whatever the pose."""
    body = joints[:, : len(BODY)]
    bones = body[:, 1:] - body[:, list(PARENTS[1 : len(BODY)])]
    return bones.square().sum(-1).clamp_min(1e-12).sqrt().sum(-1) / BONES
