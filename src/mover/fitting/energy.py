"""The state of a fit: bodies, what is seen of them, and what the energy of bodies needs of both.

Departures from the paper: terms whose weight is 0 in the preset `paper`; one floor for all people,
and that lying people do not move:

    E = Σ_t w_s² ρ(h_t; 10 cm) + Σ_t (|slope|² / σ² + ...) + Σ_{t lies} w_l² (log z_t - log z_0)²

h is the height of the lower sole above one floor for everybody, whose slopes and height are found
with the bodies: it constrains the relative distances of the bodies, not their heights.

Seen along the body, from the feet or the head, a lying person looks the same over a wide range of
distances: keypoints do not differ between 5.6 and 6.4 m, and the pose prior, which acts the same
way in each frame, moved a body by a metre (room 108). But people lie down near where they sat: z_0
is the distance before and after.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, SIDES
from mover.bodies.skinning import SkinnedBody
from mover.core.observe import Energy
from mover.core.records import record
from mover.energy.body_terms import Neighbours, body_energy
from mover.energy.config import BodyWeights
from mover.fitting import FitConfig, Stage, priors
from mover.fitting.unknowns import Frame, Points, Unknowns, floor_of, points_of
from mover.geometry.camera import project

Joints = Float[Tensor, "bodies joints 3"]
"""Of bodies, in camera axes [m]."""
Plane = tuple[Float[Tensor, "3"], Float[Tensor, ""] | float]
"""Away from the floor, in camera axes, and its height along that from the camera [m]."""

SUPPORT = 0.05  # [m], how far a joint may be under the floor
TILT = math.radians(2), math.radians(8)  # roll and pitch of a camera of unknown tilt [rad]
KNOWN_TILT, KNOWN_HEIGHT = (math.radians(0.3),) * 2, 0.01  # [rad], [m], the same for a given floor
FRAMES = 20  # whose weight on the floor equals that of its prior
NECK = BODY.index("neck")


def _of_sides(joint: str) -> list[int]:
    """The left and the right one."""
    return [BODY.index(f"{side}_{joint}") for side in SIDES]


FEET = _of_sides("ankle"), _of_sides("foot")
LIES = math.sin(math.radians(35))  # largest rise of a lying person's trunk
SITS = math.sin(math.radians(50))  # smallest rise of a seated or standing person's trunk
ALONG = 0.7  # cosine of trunk and view from which distance is hardly seen
STRAIGHT, UPRIGHT = (0.6, 0.8), (0.5, 0.75)
"""Where legs begin to carry a body and surely do: hip over ankle in lengths of the leg, and the
cosine of trunk and up."""
BALANCE = 0.08  # [m], of the centre of mass about the middle of the feet, as one walks
NEIGHBOURS = 1.0  # [s], upright frames this close to lying constrain its distance


def soles_of(model: SkinnedBody) -> Float[Tensor, "2"]:
    """Heights of ankle and ball of the foot over the sole of the mean shape [m]."""
    return model.joints[[side[0] for side in FEET], 1] - model.verts[:, 1].min()


def plane_of(floor: Float[Tensor, " floor"], up: Float[Tensor, "3"], known: float | None) -> Plane:
    """The floor that is sought, or where it is not, the one that is known."""
    if not floor.numel():
        assert known is not None
        return up, known
    across = up.new_tensor([1.0, 0.0, 0.0])
    across = torch.nn.functional.normalize(across - (across @ up) * up, dim=0)
    leaned = up + floor[0] * across + floor[1] * torch.linalg.cross(across, up)
    return leaned / leaned.norm(), floor[2]


def sole_heights(
    joints: Joints, soles: Float[Tensor, "2"], up: Float[Tensor, "3"]
) -> Float[Tensor, " bodies"]:
    """Height of the lower sole along `up` from the camera [m]."""
    low = torch.stack([(joints[:, both] @ up).amin(-1) for both in FEET], -1)
    return (low - soles.to(low)).amin(-1)


def center_of_mass(joints: Joints) -> Float[Tensor, "bodies 3"]:
    """Centre of mass by the segments of Winter 2009, Table 4.1 (head, arms, trunk as one) [m]."""
    names = ("hip", "knee", "ankle", "shoulder")
    hip, knee, ankle, shoulder = (joints[:, _of_sides(name)].mean(1) for name in names)
    upper = hip + 0.626 * (shoulder - hip)
    thigh, shank = hip + 0.433 * (knee - hip), knee + 0.606 * (ankle - knee)
    return 0.678 * upper + 0.2 * thigh + 0.122 * shank


def standing_share(joints: Joints, up: Float[Tensor, "3"]) -> Float[Tensor, " bodies"]:
    """From 0 to 1, how surely the legs carry a body: long legs below an upright trunk."""
    hip, knee, ankle = (joints[:, _of_sides(name)] for name in ("hip", "knee", "ankle"))
    length = (hip - knee).norm(dim=-1) + (knee - ankle).norm(dim=-1)
    legs = (((hip - ankle) @ up) / length.clamp_min(1e-3)).amin(1)
    trunk = trunk_of(joints) @ up
    ramps = [((x - low) / (high - low)).clamp(0, 1) for x, (low, high) in
             ((legs, STRAIGHT), (trunk, UPRIGHT))]  # fmt: skip
    return ramps[0] * ramps[1]


def balance_cost(joints: Joints, up: Float[Tensor, "3"]) -> Float[Tensor, " bodies"]:
    """Squared horizontal distance of the centre of mass from the middle of the feet [m²].

    A standing body is in balance (Tripathi et al. 2023, IPMAN, Sec. 3.3): keypoints hardly show
    that it leans towards the camera, which shortens it, so that it is put too near.
    """
    feet = joints[:, [joint for side in FEET for joint in side]].mean(1)
    off = center_of_mass(joints) - feet
    return (off - (off @ up)[:, None] * up).square().sum(-1)


def trunk_of(joints: Float[Tensor, "*bodies joints 3"]) -> Float[Tensor, "*bodies 3"]:
    """Direction from pelvis to neck."""
    return torch.nn.functional.normalize(joints[..., NECK, :] - joints[..., 0, :], dim=-1)


def distances_of_lying_people(
    joints: Joints,
    up: Float[Tensor, "3"],
    tracks: Sequence[Int[Tensor, " _"]],
    time: Float[Tensor, " bodies"],
) -> Float[Tensor, " bodies"]:
    """Logarithm of the distance along the view before and after lying, by time; NaN: free [m].

    Joints of the body are in camera axes [m], `up` is about upright; `tracks` are the rows of each
    person in the order of time [s].
    """
    trunk = trunk_of(joints)
    view = torch.nn.functional.normalize(joints[:, 0], dim=-1)
    rise = trunk @ up
    lies = (rise.abs() < LIES) & ((trunk * view).sum(-1).abs() > ALONG)
    found = torch.full_like(rise, torch.nan)
    depth = joints[:, 0, 2].clamp_min(1e-3).log()
    for rows in tracks:
        clock = time[rows].double()
        upright = _beside(lies[rows], rise[rows] > SITS, clock)
        if not bool(upright.any()):
            continue
        near = ((clock[upright][:, None] - clock[upright]).abs() <= NEIGHBOURS).double()
        known = (near @ depth[rows][upright].double()) / near.sum(1)
        expected = np.interp(clock[lies[rows]].numpy(), clock[upright].numpy(), known.numpy())
        found[rows[lies[rows]]] = torch.from_numpy(expected).to(found)
    return found


def _beside(
    lies: Bool[Tensor, " track"], sits: Bool[Tensor, " track"], time: Float[Tensor, " track"]
) -> Bool[Tensor, " track"]:
    """The upright rows before and after each stretch of lying, for a while."""
    upright = time[sits]
    if not len(upright) or not bool(lies.any()):
        return torch.zeros_like(lies)
    after = torch.searchsorted(upright, time[lies].contiguous())
    ends = torch.cat(
        [upright[(after - 1).clamp_min(0)], upright[after.clamp_max(len(upright) - 1)]]
    )
    return sits & ((time[:, None] - ends.unique()).abs() <= NEIGHBOURS).any(1)


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
        support=(pose / SUPPORT) ** 2,
        stands=(pose * config.stands) ** 2,
        balance=(pose / BALANCE) ** 2,
        level=pose**2 * FRAMES / rows,
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
    def plane(self) -> Plane:
        """The floor."""
        return plane_of(floor_of(self.at, self.frame), self.seen.up, self.seen.floor)

    @property
    def sole_height(self) -> Float[Tensor, " bodies"]:
        """Of the lower sole over the floor [m]."""
        assert self.seen.soles is not None
        up, level = self.plane
        return sole_heights(self.points.joints, self.seen.soles, up) - level

    @property
    def falling(self) -> Float[Tensor, " bodies"]:
        """Squared distance of the centre of mass from the middle of the feet [m²]."""
        return balance_cost(self.points.joints, self.plane[0])

    @property
    def slope(self) -> Float[Tensor, " bodies"]:
        """Squared slopes of the floor, and where it is known its height, in what may be."""
        floor, known = floor_of(self.at, self.frame), self.seen.floor
        tilt = TILT if known is None else KNOWN_TILT
        cost = (floor[:2] / floor.new_tensor(tilt)).square().sum()
        if known is not None:
            cost = cost + ((floor[2] - known) / KNOWN_HEIGHT).square()
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
