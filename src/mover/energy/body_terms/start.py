r"""Bodies stay near what was seen of them (Sec. "HPS estimation": the prior of the refinement).

Evidence:  the bodies as they were given, whose pose is wrong by a few degrees, whose depth is
           wrong by a few percent, and which cover the right pixels.
Price:     half the squared change over its usual size, in nats: of the joints' angles, of the
           depth, and of the place in the image (robust, in metres at the body's depth), but for
           the size there.
Departure: The paper fits the pose to the image anew (SMPLify-X's terms). Here the first fit is
           the datum, so that bodies of any source, meshes too, can be refined.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.energy.minimize import geman_mcclure

ANGLE = 0.09  # [rad], 5 degrees: usual error of a joint
BIAS = 0.03  # usual error of a person's depth in all frames, as a share
DRIFT = 0.012  # usual error that changes, as a share
PLACE = 0.03  # [m], usual error of a joint across the ray
LOST = 0.15  # [m], an error across the ray that is no longer believed
POINTS = 3.0  # joints whose places are independent: a body that is off is off as a whole
NEAR = 0.1  # [m], nearer no depth is taken to be


def angle_term(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, " bodies"]:
    """Price of turning joints by these angles [rad]; of nothing, where there are none."""
    return 0.5 * (angles / ANGLE).square().sum(-1)


def depth_share(
    points_cam: Float[Tensor, "bodies 3"], start_cam: Float[Tensor, "bodies 3"]
) -> Float[Tensor, " bodies"]:
    """Logarithm of the factor by which a body's depth has changed."""
    here, there = (x[:, 2].clamp_min(NEAR) for x in (points_cam, start_cam))
    return (here / there).log()


def range_term(
    share: Float[Tensor, " bodies"], track: Int[Tensor, " bodies"]
) -> Float[Tensor, " bodies"]:
    """Price of a change of depth: one error that a person keeps, and one that drifts about it.

    So what a seat tells about a sitter's depth holds for the same person's way through the room.

    Args:
        share: See `depth_share`.
        track: Number of each body's person, from 0.
    """
    tracks = int(track.max()) + 1 if len(track) else 0
    count = share.new_zeros(tracks).index_add(0, track, torch.ones_like(share))
    mean = share.new_zeros(tracks).index_add(0, track, share) / count.clamp_min(1)
    kept = (mean / BIAS).square()[track] / count[track]
    return 0.5 * (kept + ((share - mean[track]) / DRIFT).square())


def image_term(
    points_cam: Float[Tensor, "bodies points 3"], start_cam: Float[Tensor, "bodies points 3"]
) -> Float[Tensor, " bodies"]:
    """Price of leaving the pixels where the joints were seen.

    A body that moves along the ray of its pelvis pays nothing for its size in the image: its size
    is known no better than its depth, in all frames alike.

    Args:
        points_cam: Joints in camera axes, the pelvis first [m].
        start_cam: The same joints as they were given [m].
    """
    here, there = points_cam[..., :2], start_cam[..., :2]
    farther = points_cam[:, :1, 2:].clamp_min(NEAR) / start_cam[:, :1, 2:].clamp_min(NEAR)
    along = (farther - 1) * there[:, :1]
    z, now = (x[..., 2:].clamp_min(NEAR) for x in (start_cam, points_cam))
    leans = now - start_cam[:, :1, 2:].clamp_min(NEAR) * (farther - 1)
    off = ((here - along) / leans.clamp_min(NEAR) - there / z) * z
    robust = geman_mcclure(off.square().sum(-1).add(1e-12).sqrt(), LOST)
    return 0.5 * POINTS * (LOST / PLACE) ** 2 * robust.mean(-1)
