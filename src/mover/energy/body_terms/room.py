r"""Bodies do not sink into the room, and feet stand on its floor (after PROX, SDF term).

Evidence:  the signed distance to all furniture on one grid, and the floor's height.
Price:     sink:  rho(depth of the skin inside furniture), summed over even points of the skin
           under: the same below the floor, of the deepest points
           stand: Geman-McClure of the height of soles at rest over the floor
Paper:     the sum of the depths, of all vertices. Here a squared price up to 2 cm, because skin
           and cushions give way, and a linear one beyond; and points of the skin share one body's
           weight, so that the resolution of the mesh has none.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.energy.minimize import geman_mcclure
from mover.geometry.volume import Volume, sample

SOFT = 0.02  # [m], as far skin gives way
POINTS = 80.0  # places of the skin that count, of all that are looked at
FEW = 8  # deepest points of the skin that the floor holds: it does not give way as cushions do
DEEPEST = 8.0  # independent places among them
FEET = 4.0  # independent heights of a sole
TAIL = 5.0  # times `SOFT`, from where on a sole is not believed to stand


def sink_term(
    skin: Float[Tensor, "bodies points 3"], furniture: Volume
) -> Float[Tensor, " bodies"]:
    """Price of the skin's depth inside furniture [nats]."""
    return _dent((-sample(furniture, skin)).clamp_min(0))


def under_term(skin: Float[Tensor, "bodies points 3"], floor: float) -> Float[Tensor, " bodies"]:
    """Price of the skin's depth below the floor, whose height is given [nats]."""
    depth = (floor - skin[..., 1]).clamp_min(0)
    return DEEPEST * _dent(depth.topk(min(FEW, depth.shape[-1]), -1).values) / POINTS


def stand_term(
    soles: Float[Tensor, "bodies feet 3"],
    rest: Float[Tensor, "bodies feet"],
    floor: float,
) -> Float[Tensor, " bodies"]:
    """Price of the lowest places of feet at rest (a chance) that are not on the floor [nats]."""
    off = geman_mcclure((soles[..., 1] - floor) / SOFT, TAIL)
    return 0.5 * FEET * TAIL**2 * (rest * off).sum(-1)


def _dent(depth: Float[Tensor, "bodies points"]) -> Float[Tensor, " bodies"]:
    """Squared up to `SOFT`, linear beyond (Huber)."""
    share = depth / SOFT
    price = torch.where(share < 1, 0.5 * share.square(), share - 0.5)
    return POINTS * price.mean(-1)
