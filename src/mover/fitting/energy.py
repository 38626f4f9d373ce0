"""The state of a fit: bodies, what is seen of them, and what the energy of bodies needs of both.

Departure from the paper: terms whose weight is 0 in the preset `paper`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.skeleton import BODY
from mover.core.observe import Energy
from mover.core.records import record
from mover.energy.body_terms import Neighbours, body_energy
from mover.energy.config import BodyWeights
from mover.fitting import ground, priors
from mover.fitting.config import FitConfig, Stage
from mover.fitting.unknowns import Frame, Points, Unknowns, floor_of, points_of
from mover.geometry.camera import project

OF_SHAPES = 0.1  # relative weight for the shape of a body that lies along the view
HEIGHT = 1000.0  # [px], the image height at which the published weights were chosen
RHO = 100.0  # [px] at 1,080 rows, residual of a keypoint at which its cost is half of the most
BENDING = 3.17  # of the pose weight, for elbows and knees bent the wrong way (SMPLify-X)
HEIGHT_WEIGHT = 1e4  # [1/m], of the difference between a given height and the body's
LEGS = ("hip", "knee", "ankle", "foot")
UPPER = [k for k, name in enumerate(BODY) if k and not name.endswith(LEGS)]
"""Trunk, head and arms. A foot that stands still belongs to a body that walks on."""


@record
class TrackMotion:
    """Rows of one track at three moments, and how far people leave a straight line there."""

    near: Neighbours
    expected: Float[Tensor, " triples"]  #: second difference that people make in that time [m]
    calm: Float[Tensor, "triples joints"]
    """That of each joint, which is less where its picture stands still [m]."""


@record
class Seen:
    """What is seen of the bodies."""

    pixels: Float[Tensor, "bodies keypoints 2"]
    weight: Float[Tensor, "bodies keypoints"]
    """Confidence times the weight of the keypoint; 0: missing."""
    K: Float[Tensor, "3 3"]
    height: int  #: of the image [px]
    up: Float[Tensor, "3"]  #: away from the floor, in camera axes
    floor: float | None  #: height of the floor along `up` from the camera [m]
    centre: Float[Tensor, "bodies 63"]
    """The pose that the prior expects: of the row's posture, or of the body to start from [rad]."""
    spread: Float[Tensor, "bodies 63"]  #: how far from it each angle may be [rad]
    motion: TrackMotion | None = None  #: None: rows are not neighbours in time
    stature: priors.Stature | None = None
    """The prior of their heights; None: the mean shape's, as one more coefficient."""
    lasting: Float[Tensor, " keypoints"] | None = None
    """How far a detector puts each keypoint lastingly from the model's [m]; None: nowhere."""
    soles: Float[Tensor, "2"] | None = None
    """Heights of ankles and balls of the feet over the soles [m]; None: no floor is sought."""
    standing: Float[Tensor, " bodies"] | None = None
    """From 0 to 1, how surely the legs carry each body; None: no floor is sought."""
    about: Float[Tensor, " bodies"] | None = None
    """Expected depth of lying people, in the units of `place`; NaN, None: unconstrained."""


def weights_of(stage: Stage, config: FitConfig, height: int, rows: int) -> BodyWeights:
    """E_Body of a stage for an image of this height and so many bodies."""
    pose, smooth = stage.pose, stage.smooth
    return BodyWeights(
        keypoints=(HEIGHT / height) ** 2,
        smooth_joints=smooth * config.smooth_joints,
        smooth_pixels=smooth * config.smooth_pixels,
        still=smooth * config.still,
        held=smooth * config.held,
        support=(pose / ground.SUPPORT) ** 2,
        stands=(pose * config.stands) ** 2,
        balance=(pose / ground.BALANCE) ** 2,
        level=pose**2 * ground.FRAMES / rows,
        lies=(pose * config.lies) ** 2,
        pose=pose**2,
        limits=config.limits**2,
        bending=BENDING * pose,
        shape=stage.shape**2,
        height=HEIGHT_WEIGHT**2,
        offset=stage.shape**2,
        hands=stage.hands**2,
        jaw=stage.jaw**2,
        expression=stage.shape**2,
    )


@dataclass(frozen=True)
class FitState:
    """Bodies of a fit where they are now, in camera axes."""

    at: Unknowns
    frame: Frame
    seen: Seen
    config: FitConfig
    upper: ClassVar = UPPER

    def has(self, name: str) -> bool:
        """Whether the evidence of a term is there."""
        floor = self.at.floor.numel() > 0
        match name:
            case "motion":
                return self.seen.motion is not None and len(self.seen.motion.expected) > 0
            case "free_floor":
                return floor
            case "plane":
                return floor or self.seen.floor is not None
            case "hands" | "face":
                return getattr(self.at, name).shape[1] > 0
            case _:
                return getattr(self.seen, name, None) is not None

    def at_values(self, **fields: Tensor) -> "FitState":
        """The state with other values of some unknowns."""
        return replace(self, at=replace(self.at, **fields))

    def given(self, **fields: Any) -> "FitState":  # noqa: ANN401
        """The state with other evidence."""
        return replace(self, seen=replace(self.seen, **fields))

    def energy(self, stage: Stage) -> Energy:
        """E_Body with the weights of a stage; less of it where a body lies along the view."""
        weights = weights_of(stage, self.config, self.seen.height, len(self.at.place))
        found = body_energy(self, weights)
        if self.seen.about is None:
            return found
        share = torch.where(self.seen.about.isnan(), 1.0, OF_SHAPES)
        return Energy({name: share * part for name, part in found.parts.items()})

    @cached_property
    def points(self) -> Points:
        """Keypoints and joints [m]."""
        return points_of(self.at, self.frame)

    @cached_property
    def pixels(self) -> Float[Tensor, "bodies keypoints 2"]:
        """Projected keypoints [px]."""
        return project(self.points.keypoints, self.seen.K)

    @property
    def motion(self) -> TrackMotion:
        """Which rows follow each other."""
        assert self.seen.motion is not None
        return self.seen.motion

    @property
    def weight_between(self) -> Float[Tensor, "triples keypoints"]:
        """Weight of each keypoint in the middle one of three rows."""
        return self.seen.weight[self.motion.near.triples[:, 1]]

    @property
    def rho(self) -> float:
        """Residual of a keypoint at which its cost is half of the most [px]."""
        return RHO * self.seen.height / 1080

    @cached_property
    def sized(self) -> Float[Tensor, "bodies 22 3"]:
        """Joints of the body, in sizes of it, so that smoothness pulls no person nearer."""
        joints = self.points.joints
        if self.config.by_size:
            joints = joints / priors.size_of(joints)[:, None, None]
        return joints[:, : len(BODY)]

    @cached_property
    def plane(self) -> ground.Plane:
        """The floor."""
        return ground.plane_of(floor_of(self.at, self.frame), self.seen.up, self.seen.floor)

    @property
    def sole_height(self) -> Float[Tensor, " bodies"]:
        """Of the lower sole over the floor [m]."""
        assert self.seen.soles is not None
        up, level = self.plane
        return ground.sole_heights(self.points.joints, self.seen.soles, up) - level

    @property
    def falling(self) -> Float[Tensor, " bodies"]:
        """Squared distance of the centre of mass from the middle of the feet [m²]."""
        return ground.balance_cost(self.points.joints, self.plane[0])

    @property
    def slope(self) -> Float[Tensor, " bodies"]:
        """Squared slopes of the floor, and where it is known its height, in what may be."""
        floor, known = floor_of(self.at, self.frame), self.seen.floor
        tilt = ground.TILT if known is None else ground.KNOWN_TILT
        cost = (floor[:2] / floor.new_tensor(tilt)).square().sum()
        if known is not None:
            cost = cost + ((floor[2] - known) / ground.KNOWN_HEIGHT).square()
        return cost.expand(len(self.at.place))

    @property
    def away_from_lying(self) -> Float[Tensor, " bodies"]:
        """Logarithm of the distance over the one that is expected; 0: none is."""
        assert self.seen.about is not None
        depth, about = self.at.place[:, 2], self.seen.about
        return torch.where(about.isnan(), torch.zeros_like(depth), depth - about.nan_to_num())

    @cached_property
    def angles(self) -> Float[Tensor, "bodies angles"]:
        """Of the joints [rad]."""
        return self.frame.prior.decode(self.at.code)

    @property
    def off_pose(self) -> tuple[Tensor, Tensor | float]:
        """The pose off the one that is expected and what is usual, or a learned prior's code."""
        if self.frame.prior.width:
            return self.at.code, 1.0
        return priors.off_pose(self.angles, self.seen.centre), self.seen.spread

    @property
    def excess(self) -> Float[Tensor, "bodies 63"]:
        """Angles beyond the ranges of motion."""
        return priors.excess_of(self.angles)

    @property
    def bent(self) -> Float[Tensor, "bodies 4"]:
        """Elbows and knees, the wrong way [rad]."""
        return priors.bent_wrong(self.angles)

    @cached_property
    def count(self) -> Float[Tensor, " bodies"]:
        """Rows of each body's person."""
        rows = torch.bincount(self.frame.person, minlength=len(self.at.betas))
        return rows.to(self.at.betas)[self.frame.person]

    @property
    def same(self) -> Float[Tensor, " bodies"]:
        """Rows with independent errors: further frames repeat them."""
        return self.count.clamp_max(self.config.independent_frames)

    @property
    def shape(self) -> Float[Tensor, " bodies"]:
        """Squared standard deviations of the shape, one share for each row."""
        stature, cost = self.seen.stature, self.at.betas.square().sum(-1)
        if stature is not None and self.seen.lasting is not None:
            cost = priors.shape_cost(stature, self.at.betas)
        return cost[self.frame.person] / self.same

    @property
    def off_height(self) -> Float[Tensor, " bodies"]:
        """Squared distance from the given height, one share for each row [m²]."""
        assert self.seen.stature is not None
        return priors.height_cost(self.seen.stature, self.at.betas)[self.frame.person] / self.count
