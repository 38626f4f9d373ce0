"""One energy of bodies, for `mover fit` and `mover refine`: they differ in weights and evidence."""

from typing import Any

import torch

from mover.core.observe import Energy
from mover.energy import body_terms as of
from mover.energy.body_contact import touch_term
from mover.energy.config import BodyWeights
from mover.energy.minimize import Term, active_weights, sum_terms

STEP = 0.1  # [m], feet that are higher are not on the floor
FALLING = 0.3  # [m], a centre of mass farther out is held by something else


BODY_TERMS: tuple[Term[Any], ...] = (
    # E_Body, of bodies that are fitted to keypoints; in camera axes
    Term(
        "keypoints", lambda b: of.keypoint_term(b.pixels, b.seen.pixels, b.seen.weight, b.rho),
        ("pixels",),
    ),
    Term(
        "smooth_joints",
        lambda b: of.motion_term(
            b.sized, b.motion.near, b.motion.expected[:, None], of.SIGMA_JOINTS),
        ("motion",),
    ),
    Term(
        "smooth_pixels",
        lambda b: of.motion_term(b.pixels, b.motion.near, 1 / b.weight_between, of.SIGMA_PIXELS),
        ("motion",),
    ),
    Term(  # a body along the view; not robust, since a single frame is off by a metre
        "still", lambda b: of.motion_term(b.sized[:, :1], b.motion.near, b.motion.calm[:, :1]),
        ("motion",),
    ),
    Term(  # single frames hardly constrain the depth of an arm, either
        "held", lambda b: of.motion_term(
            b.sized[:, b.upper] - b.sized[:, :1], b.motion.near, b.motion.calm[:, b.upper],
            of.SIGMA_HELD),
        ("motion",),
    ),
    Term(
        "support",
        lambda b: of.support_term(torch.cat([b.points.joints, b.points.keypoints], 1), *b.plane),
        ("plane",),
    ),
    Term("stands", lambda b: of.robust_square(b.sole_height.square(), STEP), ("free_floor",)),
    Term(
        "balance", lambda b: b.seen.standing * of.robust_square(b.falling, FALLING),
        ("free_floor", "standing"),
    ),
    Term("level", lambda b: b.slope, ("free_floor",)),
    Term("lies", lambda b: b.away_from_lying.square(), ("about",)),
    Term("pose", lambda b: of.deviation_term(*b.off_pose), ("pixels",)),
    Term("limits", lambda b: of.deviation_term(b.excess), ("pixels",)),
    Term("bending", lambda b: b.bent.exp().square().sum(-1), ("pixels",)),
    Term("shape", lambda b: b.shape, ("pixels",)),
    Term("height", lambda b: b.off_height, ("stature",)),
    Term(
        "offset", lambda b: of.deviation_term(
            b.at.offset.flatten(1), b.seen.lasting.repeat_interleave(3))[b.frame.person] / b.same,
        ("lasting",),
    ),
    Term("hands", lambda b: of.deviation_term(b.at.hands), ("hands",)),
    Term(
        "jaw", lambda b: (
            of.deviation_term(b.at.face[:, :1]) + 100 * of.deviation_term(b.at.face[:, 1:3])),
        ("face",),
    ),
    Term("expression", lambda b: of.deviation_term(b.at.face[:, 3:]), ("face",)),
    # The refinement of given bodies in a room; in its world
    Term("angles", lambda b: 0.5 * of.deviation_term(b.angles, of.ANGLE), ("given",)),
    Term("image", lambda b: of.image_term(b.points_cam, b.start_cam), ("given",)),
    Term("range", lambda b: of.range_term(b.share, b.known.near.track), ("given",)),
    Term("smooth", lambda b: of.smooth_term(b.now.points, b.known.near), ("given",)),
    Term("steady", lambda b: of.steady_term(b.angles, b.share, b.known.near), ("given",)),
    Term("under", lambda b: of.under_term(b.even, b.known.floor), ("given",)),
    Term("stand", lambda b: of.stand_term(b.feet[1], b.known.rest, b.known.floor), ("feet",)),
    Term("lock", lambda b: of.lock_term(b.feet[0], b.known.rest, b.known.near), ("feet",)),
    Term("sink", lambda b: of.sink_term(b.even, b.known.furniture), ("furniture",)),
    Term("touch", lambda b: touch_term(b.now.skin, b.known.matches, b.known.rho), ("matches",)),
    Term(
        "order", lambda b: of.order_term(b.in_camera(b.even)[..., 2], b.known.bounds), ("bounds",),
    ),
    Term(
        "outline", lambda b: of.outline_term(
            b.in_camera(b.now.skin), b.known.outline, b.known.camera.K, b.known.camera.width),
        ("outline",),
    ),
)  # fmt: skip
"""All terms of the energy of bodies; a new one is a function, a weight and a row."""


def body_energy(state: Any, weights: BodyWeights) -> Energy:  # noqa: ANN401
    """The cost of bodies, one value each; terms whose evidence `state.has` not are left out."""
    return sum_terms(active_weights(weights, BODY_TERMS, state.has), BODY_TERMS, state)
