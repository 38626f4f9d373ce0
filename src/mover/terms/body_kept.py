r"""An error that lasts says no more in a hundred frames than in one.

Evidence:  signed distances that should be zero, in groups whose items share an error: of a part of
           a person's skin over a piece that it touches.
Price:     the shared error in its usual size, and the rest of each distance without it. The shared
           error is the one that is cheapest, in closed form (ridge mean with robust weights).
"""

from jaxtyping import Float, Int
from torch import Tensor


def without_kept(
    off: Float[Tensor, " items"],
    trust: Float[Tensor, " items"],
    group: Int[Tensor, " items"],
    usual: float,
) -> tuple[Float[Tensor, " items"], Float[Tensor, " items"]]:
    """What is left of distances without the error that their group shares, and its price.

    Args:
        off: Signed distances [m].
        trust: One over the variance of each alone [1/m²].
        group: Which items share an error, from 0.
        usual: Size of the shared error [m].

    Returns:
        The rest [m], and each item's share of the price [nats].
    """
    count = int(group.max()) + 1 if len(group) else 0
    total = off.new_zeros(count).index_add(0, group, trust)
    mean = off.new_zeros(count).index_add(0, group, trust * off) / (total + usual**-2)
    part = trust / total.clamp_min(1e-9)[group]
    return off - mean[group], 0.5 * (mean / usual).square()[group] * part
