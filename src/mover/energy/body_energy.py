"""One energy of bodies, for `mover fit` and `mover refine`: they differ in weights and evidence."""

from typing import Any, Protocol, runtime_checkable

import torch

from mover.core.observe import Energy
from mover.energy.body_contact import touch_term
from mover.energy.body_terms import (
    ANGLE,
    SIGMA_HELD,
    SIGMA_JOINTS,
    SIGMA_PIXELS,
    deviation_term,
    image_term,
    keypoint_term,
    lock_term,
    motion_term,
    order_term,
    outline_term,
    range_term,
    robust_square,
    sink_term,
    smooth_term,
    stand_term,
    steady_term,
    support_term,
    under_term,
)
from mover.energy.config import BodyWeights
from mover.energy.minimize import Term, active_weights, sum_terms

STEP = 0.1  # [m], feet that are higher are not on the floor
FALLING = 0.3  # [m], a centre of mass farther out is held by something else


@runtime_checkable
class BodyState(Protocol):
    """Bodies where they are now, with what terms need of them (computed once, when it is asked)."""

    def has(self, name: str) -> bool:
        """Whether the evidence of a term is there."""
        ...


BODY_TERMS: tuple[Term[Any], ...] = (
    # E_Body, of bodies that are fitted to keypoints; in camera axes
    Term(
        "keypoints", lambda b: keypoint_term(b.pixels, b.seen.pixels, b.seen.weight, b.rho),
        "its keypoints", ("pixels",),
    ),
    Term(
        "smooth_joints",
        lambda b: motion_term(b.sized, b.motion.near, b.motion.expected[:, None], SIGMA_JOINTS),
        "smooth joints", ("motion",),
    ),
    Term(
        "smooth_pixels",
        lambda b: motion_term(b.pixels, b.motion.near, 1 / b.weight_between, SIGMA_PIXELS),
        "smooth keypoints", ("motion",),
    ),
    Term(  # a body along the view; not robust, since a single frame is off by a metre
        "still", lambda b: motion_term(b.sized[:, :1], b.motion.near, b.motion.calm[:, :1]),
        "a still pelvis", ("motion",),
    ),
    Term(  # single frames hardly constrain the depth of an arm, either
        "held", lambda b: motion_term(
            b.sized[:, b.upper] - b.sized[:, :1], b.motion.near, b.motion.calm[:, b.upper],
            SIGMA_HELD),
        "a still trunk", ("motion",),
    ),
    Term(
        "support",
        lambda b: support_term(torch.cat([b.points.joints, b.points.keypoints], 1), *b.plane),
        "a floor under it", ("plane",),
    ),
    Term(
        "stands", lambda b: robust_square(b.sole_height.square(), STEP),
        "one floor for everybody", ("free_floor",),
    ),
    Term(
        "balance", lambda b: b.seen.standing * robust_square(b.falling, FALLING),
        "its balance", ("free_floor", "standing"),
    ),
    Term("level", lambda b: b.slope, "a level floor", ("free_floor",)),
    Term("lies", lambda b: b.away_from_lying.square(), "where it lay down", ("about",)),
    Term("pose", lambda b: deviation_term(*b.off_pose), "usual poses", ("pixels",)),
    Term("limits", lambda b: deviation_term(b.excess), "ranges of motion", ("pixels",)),
    Term("bending", lambda b: b.bent.exp().square().sum(-1), "straight knees", ("pixels",)),
    Term("shape", lambda b: b.shape, "usual shapes", ("pixels",)),
    Term("height", lambda b: b.off_height, "its given height", ("stature",)),
    Term(
        "offset", lambda b: deviation_term(
            b.at.offset.flatten(1), b.seen.lasting.repeat_interleave(3))[b.frame.person] / b.same,
        "the detector's habits", ("lasting",),
    ),
    Term("hands", lambda b: deviation_term(b.at.hands), "usual hands", ("hands",)),
    Term(
        "jaw", lambda b: deviation_term(b.at.face[:, :1]) + 100 * deviation_term(b.at.face[:, 1:3]),
        "a closed mouth", ("face",),
    ),
    Term("expression", lambda b: deviation_term(b.at.face[:, 3:]), "usual faces", ("face",)),
    # The refinement of given bodies in a room; in its world
    Term(
        "angles", lambda b: 0.5 * deviation_term(b.angles, ANGLE),
        "the pose it was given", ("given",),
    ),
    Term(
        "image", lambda b: image_term(b.points_cam, b.start_cam),
        "where it was seen", ("given",),
    ),
    Term(
        "range", lambda b: range_term(b.share, b.known.near.track),
        "the depth it was given", ("given",),
    ),
    Term("smooth", lambda b: smooth_term(b.now.points, b.known.near), "smooth motion", ("given",)),
    Term(
        "steady", lambda b: steady_term(b.angles, b.share, b.known.near),
        "steady corrections", ("given",),
    ),
    Term("under", lambda b: under_term(b.even, b.known.floor), "the floor below it", ("given",)),
    Term(
        "stand", lambda b: stand_term(b.feet[1], b.known.rest, b.known.floor),
        "soles on the floor", ("feet",),
    ),
    Term(
        "lock", lambda b: lock_term(b.feet[0], b.known.rest, b.known.near),
        "soles that rest", ("feet",),
    ),
    Term(
        "sink", lambda b: sink_term(b.even, b.known.furniture),
        "furniture around it", ("furniture",),
    ),
    Term(
        "touch", lambda b: touch_term(b.now.skin, b.known.matches, b.known.rho),
        "touch", ("matches",),
    ),
    Term(
        "order", lambda b: order_term(b.in_camera(b.even)[..., 2], b.known.bounds),
        "who hides whom", ("bounds",),
    ),
    Term(
        "outline", lambda b: outline_term(
            b.in_camera(b.now.skin), b.known.outline, b.known.camera.K, b.known.camera.width),
        "its outline", ("outline",),
    ),
)  # fmt: skip
"""All terms of the energy of bodies; a new one is a function, a weight and a row."""


def body_energy(state: BodyState, weights: BodyWeights) -> Energy:
    """The cost of bodies, one value each; terms whose evidence is missing are left out."""
    return sum_terms(active_weights(weights, BODY_TERMS, state.has), BODY_TERMS, state)
