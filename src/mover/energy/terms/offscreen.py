r"""Objects stay inside the image (the authors' release; not in the paper).

Price:  L_off = \sum_i \sum_v [outside the image in pixels at 640] + ReLU(-z) + ReLU(z - 8 m)

It sums over the vertices, so its weight depends on the mesh, as in the release.
"""

from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.devices import constant
from mover.core.types import Camera
from mover.energy.terms.bbox import WIDTH

FARTHEST = 8.0  # [m]


def offscreen_term(
    pixels: Float[Tensor, "*starts objects verts 2"],
    verts_cam: Float[Tensor, "*starts objects verts 3"],
    real: Bool[Tensor, "objects verts"],
    camera: Camera,
) -> Float[Tensor, "*starts objects"]:
    """Pixels by which vertices leave the image, and metres by which they leave 0-8 m."""
    size = constant((camera.width, camera.height), pixels)
    beyond = ((pixels - size).relu() + (-pixels).relu()).sum(-1) * (WIDTH / camera.width)
    z = verts_cam[..., 2]
    return (beyond + (-z).relu() + (z - FARTHEST).relu()).mul(real).sum(-1)
