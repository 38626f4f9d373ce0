r"""Objects keep their initial size (supplement, "Loss Terms").

Price:     L_scale = \sum_i \| s_i / s_i^{init} - 1 \|_2
Paper:     the norm as printed (its square root is rounded off below one millionth).
Robust:    in logarithms, so that half and double cost the same; an object that grows or shrinks as
           a whole pays less than half of what it pays for a change of shape (g = 1.5), and sizes
           beyond 0.6 or 1.6 of the initial one cost steeply more:
           \sum_k (l_k - m)^2 + g m^2 + 10 \sum_k out(l_k)^2,  m = mean l_k
Reading:   the supplement calls the weight of this term lambda_3 in Eq. 1 but lambda_2 in L_scene;
           here both stages use 1000 (Eq. 1 and the released code agree).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mover.energy.config import GROWTH, Variant
from mover.energy.minimize import safe_norm

LOWEST, HIGHEST = math.log(0.6), math.log(1.6)


def scale_term(
    log_scale: Float[Tensor, "*starts objects 3"], form: Variant, growth: float = GROWTH
) -> Float[Tensor, "*starts objects"]:
    """Distance of the size from the initial one [1]; `growth`: price of all three together."""
    if form == "paper":
        return safe_norm(log_scale.exp() - 1)
    mean = log_scale.mean(-1, keepdim=True)
    out = (log_scale - HIGHEST).relu() + (LOWEST - log_scale).relu()
    shape = (log_scale - mean).square().sum(-1)
    return shape + growth * mean[..., 0].square() + 10 * torch.square(out).sum(-1)
