r"""Front surfaces lie where a depth network sees them (not in the paper).

Evidence:  d(p), the depth of the still image after its scale (and shift) were fitted to the room,
           and sigma, how far a network is off [share], gathered in `stages.objects.gather_depth`.
Price:     L_measured = \sum_i mean_{p in Sil_i, M_i} 2 \log(1 + \delta^2 / 3 \sigma^2) [nats],
           \delta = \log D_i(p) - \log d(p), a Student t
Mean:      errors of a network are smooth: the pixels of one object are off together, so that an
           object has one measurement, however large it is in the image.
"""

from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.geometry.raster import Depths

FEWEST = 100.0  # pixels by which a sum is divided at least
NEAREST = 0.05  # [m], nothing is nearer


@record
class Measured:
    """The measured depth in the windows of the objects."""

    depth: Float[Tensor, "objects h w"]
    """[m]; 0 where it is not known."""
    spread: Float[Tensor, " objects"]
    """How far it is off: standard deviation of its logarithm."""


def measured_term(
    seen: Depths, mask: Float[Tensor, "objects h w"], known: Measured
) -> Float[Tensor, "*starts objects"]:
    """How far the drawn surfaces are from the measured ones [nats]."""
    there = seen.covered & (mask > 0.5) & (known.depth > 0)
    drawn, measured = (x.clamp_min(NEAREST).log() for x in (seen.nearest, known.depth))
    off = (drawn - measured) / known.spread[:, None, None]
    price = 2 * (1 + off.square() / 3).log()
    return (price * there).sum((-2, -1)) / there.sum((-2, -1)).clamp_min(FEWEST)
