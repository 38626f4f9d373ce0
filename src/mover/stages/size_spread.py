r"""How far the given sizes of a room's furniture are off, as its image tells (not in the paper).

The price of sizes (`terms.scale`) suits tools whose sizes err as much as usual. Where the image
alone changes the shapes of a room's furniture more than that, the sizes that it cannot tell (the
depth of a cabinet that is seen from the front) are worth less too. Logarithms of the three sizes
of a piece are c + e_k, with c common (a piece that was placed too far was made too large) and e_k
independent; then the price of a normal distribution is

    \sum_k (l_k - m)^2 / v + 3 m^2 / (v + 3 w),   m = mean l_k,  v = var e_k,  w = var c,

of which v is learnt from the room (empirical Bayes) and w is not. A piece whose silhouette cannot
be made to fit (another shape, a bad mask) changes its sizes whether they are wrong or not, so it
counts by the square of what its silhouette is believed.
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..types import Layout

FIT = 0.1  # image energy (robust form) from which on an object's shape is believed less
LEAST = 0.1  # of what a silhouette that fits is believed


@dataclass(frozen=True)
class SpreadConfig:
    """How the price of sizes follows the room."""

    usual: float = 0.0
    """Usual standard deviation of the logarithm of a size; 0: nothing is learnt."""
    common: float = 0.03
    """That of what the three sizes of a piece have in common."""
    known: float = 2.0
    """How many pieces of a usual room count as if they were seen."""
    most: float = 4.0
    """The largest spread that is believed, in usual ones; the smallest is 1."""


def believed(energy: Float[Tensor, " objects"]) -> Float[Tensor, " objects"]:
    """How far the shapes of objects are believed: 1 where the image can be made to fit.

    Args:
        energy: What is left of the image's energy (robust form) where each object fits best.
    """
    return (FIT / energy.clamp_min(1e-6)).clamp(LEAST, 1)


def learnt_sizes(
    layout: Layout, trust: Float[Tensor, " objects"], config: SpreadConfig
) -> tuple[float, float]:
    """Factors on the price of another shape, and on that of another size as a whole.

    Args:
        layout: Where and how large the image alone has the objects, of one start.
        trust: How far the shape of each is believed, see `believed`.
        config: What is usual.
    """
    if config.usual <= 0:
        return 1.0, 1.0
    log_scale, usual, share = layout.log_scale, config.usual**2, trust.square()
    shape = (log_scale - log_scale.mean(-1, keepdim=True)).square().sum(-1) / 2
    found = (config.known * usual + float(share @ shape)) / (config.known + float(share.sum()))
    found = min(max(found, usual), usual * config.most**2)
    together = 3 * config.common**2
    return usual / found, (usual + together) / (found + together)
