"""What the image, time and the room say about where people are (Sec. "HPS estimation")."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.corrected import Correction, MovedSkin, Puppet, moved
from mover.core.observe import Energy
from mover.core.types import Camera
from mover.energy.body_contact import Matches, touch_term
from mover.energy.body_terms import (
    Bounds,
    Neighbours,
    Outline,
    angle_term,
    depth_share,
    image_term,
    lock_term,
    order_term,
    outline_term,
    range_term,
    sink_term,
    smooth_term,
    stand_term,
    steady_term,
    under_term,
)
from mover.energy.config import BodyWeights
from mover.energy.minimize import Term, active_weights, sum_terms, there
from mover.geometry.camera import to_camera
from mover.geometry.volume import Volume


@dataclass(frozen=True)
class SolePoints:
    """The soles among the picked vertices."""

    members: Bool[Tensor, "feet picked"]
    rest: Float[Tensor, "bodies feet"]
    """Chance that each is at rest and carries the body."""


@dataclass(frozen=True)
class BodyEvidence:
    """What is known about some rows of the bodies."""

    camera: Camera
    floor: float
    """Its height in the world [m]."""
    furniture: Volume | None
    near: Neighbours
    feet: SolePoints
    matches: Matches | None
    bounds: Bounds | None
    rho: float
    """Of the contact [m]."""
    even: Bool[Tensor, " picked"]
    """Points of the skin that lie evenly over the body."""
    outline: Outline | None = None

    def has(self, name: str) -> bool:
        """Whether a field is known and says something."""
        found = getattr(self, name)
        if isinstance(found, Matches | Outline):
            return len(found.body) > 0
        return bool(found.members.any()) if isinstance(found, SolePoints) else found is not None


@dataclass(frozen=True)
class MovedBodies:
    """The bodies after a correction, and what several terms need of them."""

    by: Correction
    puppet: Puppet
    known: BodyEvidence
    now: MovedSkin

    @cached_property
    def points_cam(self) -> Float[Tensor, "bodies points 3"]:
        """Joints in camera axes [m]."""
        return to_camera(self.now.points, self.known.camera.R_cam_world)

    @cached_property
    def start_cam(self) -> Float[Tensor, "bodies points 3"]:
        """The same before the correction [m]."""
        return to_camera(self.puppet.points, self.known.camera.R_cam_world)

    @cached_property
    def share(self) -> Float[Tensor, " bodies"]:
        """Logarithm of the factor by which depths have changed."""
        return depth_share(self.points_cam[:, 0], self.start_cam[:, 0])

    @cached_property
    def angles(self) -> Float[Tensor, "bodies angles"]:
        """All by which the body was turned [rad]."""
        return torch.cat([self.by.turn, self.by.angles], -1)

    @cached_property
    def even(self) -> Float[Tensor, "bodies even 3"]:
        """Points that lie evenly over the skin [m]."""
        return self.now.skin[:, self.known.even]

    @cached_property
    def soles(self) -> tuple[Float[Tensor, "bodies feet 3"], Float[Tensor, "bodies feet 3"]]:
        """Middle of each sole, and its middle again at the height of its lower half [m]."""
        return _soles(self.now, self.known.feet)

    def in_camera(self, points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any 3"]:
        """Points of the world in camera axes [m]."""
        return to_camera(points, self.known.camera.R_cam_world)


BODY_TERMS: tuple[Term[MovedBodies], ...] = (
    Term("angles", lambda b: angle_term(b.angles), "the pose it was given"),
    Term("image", lambda b: image_term(b.points_cam, b.start_cam), "where it was seen"),
    Term("range", lambda b: range_term(b.share, b.known.near.track), "the depth it was given"),
    Term("smooth", lambda b: smooth_term(b.now.points, b.known.near), "smooth motion"),
    Term("steady", lambda b: steady_term(b.angles, b.share, b.known.near), "steady corrections"),
    Term("under", lambda b: under_term(b.even, b.known.floor), "the floor below it"),
    Term(
        "stand", lambda b: stand_term(b.soles[1], b.known.feet.rest, b.known.floor),
        "soles on the floor", ("feet",),
    ),
    Term(
        "lock", lambda b: lock_term(b.soles[0], b.known.feet.rest, b.known.near),
        "soles that rest", ("feet",),
    ),
    Term(
        "sink", lambda b: sink_term(b.even, there(b.known.furniture)),
        "furniture around it", ("furniture",),
    ),
    Term(
        "touch", lambda b: touch_term(b.now.skin, there(b.known.matches), b.known.rho),
        "touch", ("matches",),
    ),
    Term(
        "order", lambda b: order_term(b.in_camera(b.even)[..., 2], there(b.known.bounds)),
        "who hides whom", ("bounds",),
    ),
    Term(
        "outline", lambda b: outline_term(
            b.in_camera(b.now.skin), there(b.known.outline),
            b.known.camera.K, b.known.camera.width),
        "its outline", ("outline",),
    ),
)  # fmt: skip
"""All terms of the energy of the bodies; a new one is a function, a weight and a row."""


def body_energy(
    by: Correction, puppet: Puppet, known: BodyEvidence, weights: BodyWeights
) -> Energy:
    """The cost of a correction, one value for each body."""
    at = MovedBodies(by, puppet, known, moved(puppet, by))
    return sum_terms(active_weights(weights, BODY_TERMS, known.has), BODY_TERMS, at)


def _soles(now: MovedSkin, feet: SolePoints) -> tuple[Tensor, Tensor]:
    """Middle of each sole, and its middle again at the height of its lower half [m]."""
    middles: list[Tensor] = []
    lows: list[Tensor] = []
    for own in feet.members:  # two feet
        sole = now.skin[:, own]
        middle = sole.mean(1) if sole.shape[1] else now.points[:, 0]
        heights = sole[..., 1].sort(1).values[:, : max(1, (sole.shape[1] + 1) // 2)]
        low = heights.mean(1) if sole.shape[1] else middle[:, 1]
        middles.append(middle)
        lows.append(torch.stack([middle[:, 0], low, middle[:, 2]], -1))
    return torch.stack(middles, 1), torch.stack(lows, 1)
