r"""How far the initial sizes of a room's furniture are off, from its image (not in the paper).

The cost of sizes (the scale term) suits tools whose sizes err as much as usual. Where the image
alone changes the shapes of a room's furniture more than that, the sizes that it cannot constrain
(the depth of a cabinet that is seen from the front) are weighted less too. Logarithms of the three
sizes of an object are c + e_k, with c common (an object that was placed too far was made too large)
and e_k independent; then the cost of a normal distribution is

    \sum_k (l_k - m)^2 / v + 3 m^2 / (v + 3 w),   m = mean l_k,  v = var e_k,  w = var c,

of which v is learnt from the room (empirical Bayes) and w is not. An object whose silhouette cannot
be made to fit (another shape, a bad mask) changes its sizes whether they are wrong or not, so it
counts by the square of the weight of its silhouette.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.types import Layout
from mover.stages.config import SpreadConfig

FIT = 0.1  # image energy (robust form) from which on an object's shape is weighted less
WIDEST = 4.0  # largest spread that is learnt, in usual ones; the smallest is 1
LEAST = 0.1  # of the weight of a silhouette that fits


def inlier_weights(energy: Float[Tensor, " objects"]) -> Float[Tensor, " objects"]:
    """Weights of the shapes of objects: 1 where the image can be made to fit.

    Args:
        energy: What is left of the image's energy (robust form) where each object fits best.
    """
    return (FIT / energy.clamp_min(1e-6)).clamp(LEAST, 1)


def estimate_size_prior(
    layout: Layout, trust: Float[Tensor, " objects"], config: SpreadConfig
) -> tuple[float, float]:
    """Factors on the cost of another shape, and on that of another size as a whole.

    Args:
        layout: Where and how large the image alone has the objects, of one start.
        trust: Weight of the shape of each, see `inlier_weights`.
        config: What is usual.
    """
    if config.usual <= 0:
        return 1.0, 1.0
    log_scale, usual, share = layout.log_scale, config.usual**2, trust.square()
    shape = (log_scale - log_scale.mean(-1, keepdim=True)).square().sum(-1) / 2
    found = (config.known * usual + float(share @ shape)) / (config.known + float(share.sum()))
    found = min(max(found, usual), usual * WIDEST**2)
    together = 3 * config.common**2
    return usual / found, (usual + together) / (found + together)
