"""What is known of people before they are seen: ranges of motion, poses, statures, and detectors.

Limits are a pose prior from anatomy, which needs no file. θ are axis-angle components of the 21
joints of the body about the axes of the T-pose (+x to the person's left, +y up, +z to the front).
Ranges are the normal ranges of motion of the American Academy of Orthopaedic Surgeons ("Joint
Motion", 1965) and of Kapandji ("The Physiology of the Joints"), rounded; ranges of spine and neck
are shared among their joints. Rest and spread are ours: a person with hanging arms, and half of the
range that daily life uses.

Keypoints hardly constrain the stature: a body that is a tenth taller and a tenth farther away has
the same projection, and the proportions of a detector's joints are not those of a body model. So
distances rest on the prior of the stature: that of adults of unknown sex, or a given height.

A detector's hip is not the model's hip joint, either: annotators click the skin, and a network
repeats its errors while a person keeps a posture. Three networks put the joints of one sitting man
lastingly 1 to 3 px apart where he is 320 px tall (.5 to 1.8 cm), beside noise of 1.1 to 1.6 px that
is new in each frame. A hundred frames do not average that out, so each keypoint of each person has
an offset in the axes of its bone, with a prior of the lengths below.
"""

import math
from functools import lru_cache
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, FINGERS, PARENTS
from mover.bodies.skinning import SkinnedBody, heights_of
from mover.core.errors import InputError
from mover.core.records import record

Range = tuple[float, float, float, float]
"""Lowest angle, highest angle, rest and spread [degrees]."""

_SPINE = ((-12, 30, 3, 10), (-17, 17, 0, 7), (-13, 13, 0, 6))
_NECK = ((-30, 30, 5, 14), (-40, 40, 0, 16), (-23, 23, 0, 8))
LEFT: dict[str, tuple[Range, Range, Range]] = {
    "hip": ((-125, 30, -25, 38), (-45, 50, 5, 14), (-30, 48, 2, 13)),
    "knee": ((-5, 150, 30, 42), (-12, 12, 0, 6), (-8, 8, 0, 4)),
    "ankle": ((-25, 50, -5, 14), (-22, 22, 0, 9), (-22, 22, 0, 8)),
    "foot": ((-45, 25, 0, 10), (-6, 6, 0, 3), (-6, 6, 0, 3)),
    "collar": ((-8, 8, 0, 4), (-16, 16, 0, 7), (-12, 32, 0, 8)),
    "shoulder": ((-95, 80, 5, 28), (-130, 45, -15, 32), (-100, 80, -62, 28)),
    "elbow": ((-60, 70, 0, 22), (-150, 5, -42, 40), (-12, 12, 0, 8)),
    "wrist": ((-60, 60, 0, 20), (-30, 25, 0, 10), (-70, 75, 0, 18)),
}
"""Limits of the left joints about x, y and z; the right ones mirror them."""
MIDDLE: dict[str, tuple[Range, Range, Range]] = {
    "spine1": _SPINE, "spine2": _SPINE, "spine3": _SPINE, "neck": _NECK, "head": _NECK,
}  # fmt: skip
"""Limits of the joints in the middle of the body."""
STIFFNESS = 1 / math.radians(4.0)  # beyond a limit four degrees are one standard deviation


@lru_cache(maxsize=1)
def limit_table() -> Float[Tensor, "4 63"]:
    """Lowest, highest, rest and spread of all angles of the body [rad]."""
    rows = list[Range]()
    for joint in BODY[1:]:
        side, _, name = joint.rpartition("_")
        x, y, z = LEFT[name] if side else MIDDLE[name]
        if side == "right":
            y, z = ((-high, -low, -rest, spread) for low, high, rest, spread in (y, z))
        rows += [x, y, z]
    return torch.deg2rad(torch.tensor(rows, dtype=torch.float64)).mT.contiguous()


def excess_of(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, "bodies 63"]:
    """How far angles exceed the ranges of motion, in units of `1 / STIFFNESS`; 0 within them."""
    low, high, _, _ = limit_table().to(angles)
    body = angles[:, :63]
    return ((low - body).clamp_min(0) + (body - high).clamp_min(0)) * STIFFNESS


def resting(bodies: int, like: Tensor) -> Float[Tensor, "bodies 63"]:
    """A standing person with hanging arms [rad]."""
    return limit_table()[2].to(like).expand(bodies, -1).clone()


def spreads(bodies: int, like: Tensor, loose: tuple[str, ...] = ()) -> Float[Tensor, "bodies 63"]:
    """How far each angle of identical rows is from its rest in daily life [rad].

    Joints that are `loose` may be anywhere: the deviation of what is uniform in their ranges.
    """
    low, high, _, spread = limit_table().to(like)
    free = torch.tensor([any(name in joint for name in loose) for joint in BODY[1:]])
    free = free.repeat_interleave(3).to(like.device)
    return torch.where(free, (high - low) / math.sqrt(12), spread).expand(bodies, -1)


BENT = ((17, 1, 1.0), (18, 1, -1.0), (3, 0, -1.0), (4, 0, -1.0))
"""Elbows and knees: joint of the body, axis, and the sign that is the wrong way."""
HIPS, KNEES, ANKLES = (
    [3 * (BODY.index(f"{side}_{joint}") - 1) for side in ("left", "right")]
    for joint in ("hip", "knee", "ankle")
)  # their bending among the angles of the body


def bent_wrong(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, "bodies 4"]:
    """Angles of elbows and knees, positive the wrong way [rad]: E_bend is Σ exp(θ)²."""
    return torch.stack([sign * angles[:, 3 * joint + axis] for joint, axis, sign in BENT], -1)


def off_pose(
    angles: Float[Tensor, "bodies angles"], centre: Float[Tensor, "bodies 63"]
) -> Float[Tensor, "bodies 63"]:
    """Angles off the pose that is expected, of ankles as they keep the feet level [rad].

    Few detectors see toes. An ankle that is expected to turn back what hip and knee turn forth
    keeps the foot as level as the trunk is upright; one at rest would stand people on their toes.
    """
    away = angles[:, :63] - centre
    level = away.index_add(1, away.new_tensor(ANKLES, dtype=torch.long), away[:, HIPS])
    return level.index_add(1, away.new_tensor(ANKLES, dtype=torch.long), away[:, KNEES])


ADULT, ADULTS = 1.68, 0.10  # [m], mean and spread of adults of either sex (NCD-RisC 2016)
HELD = 0.04  # [m], by which proportions move an unknown height: they hardly show it
UNKNOWN = ADULTS / ADULT  # standard deviation of the logarithm of an unknown height
BONES = 4.6  # [m], the 21 bones of a usual person end to end


@record
class Stature:
    """Stature as a linear function of the shape coefficients, and the given heights."""

    usual: float  #: height of the mean shape [m]
    dirs: Float[Tensor, " shape"]  #: what each number of the shape adds to it [m]
    given: Float[Tensor, " people"]  #: height of each person [m]; NaN: unknown

    def heights(self, betas: Float[Tensor, "people shape"]) -> Float[Tensor, " people"]:
        """Height of each person [m]."""
        return self.usual + betas @ self.dirs[: betas.shape[1]].to(betas)


def stature_of(
    model: SkinnedBody,
    heights: tuple[float, ...],
    person: Int[Tensor, " bodies"],
    rows: Int[Tensor, " some"],
) -> Stature:
    """The prior of the heights of the people in the rows that are fitted.

    `heights` [m] are of each person in the order of their numbers, or one for everybody.

    Raises:
        InputError: If there are others than there are people.
    """
    everybody = person.unique()
    heights = heights or (math.nan,)
    if len(heights) not in (1, len(everybody)):
        raise InputError(
            f"height: {len(heights)} are given, expected 1, or {len(everybody)}: one a person"
        )
    given = torch.tensor(heights).expand(len(everybody))
    return Stature(*heights_of(model), given[torch.isin(everybody, person[rows])])


def height_cost(stature: Stature, betas: Float[Tensor, "people shape"]) -> Float[Tensor, " people"]:
    """Squared distance from the given height [m²]; 0 where none is given."""
    off = stature.heights(betas) - stature.given.to(betas)
    return torch.where(off.isfinite(), off, torch.zeros_like(off)).square()


def shape_cost(stature: Stature, betas: Float[Tensor, "people shape"]) -> Float[Tensor, " people"]:
    """Squared standard deviations from the population: of proportions, and of an unknown height.

    Proportions are the shape coefficients without their part along the gradient of the height.
    """
    dirs = stature.dirs[: betas.shape[1]].to(betas)
    along = betas @ dirs / dirs.norm()
    off = (stature.heights(betas) - ADULT) / HELD
    unknown = stature.given.isnan().to(betas.device)
    rest = (betas.square().sum(-1) - along.square()).clamp_min(0)
    return rest + torch.where(unknown, off, torch.zeros_like(off)).square()


def size_of(joints: Float[Tensor, "bodies joints 3"]) -> Float[Tensor, " bodies"]:
    """How large bodies are: 1 for a usual person, whatever the pose."""
    body = joints[:, : len(BODY)]
    bones = body[:, 1:] - body[:, list(PARENTS[1 : len(BODY)])]
    return bones.square().sum(-1).clamp_min(1e-12).sqrt().sum(-1) / BONES


LASTING = {"hip": 0.03, "pelvis": 0.03, "neck": 0.03, "shoulder": 0.02, "knee": 0.02}
"""[m], prior standard deviation of an offset along each axis, by the last word of the name."""
OTHERS = 0.015  # [m], of all other keypoints of the body
FINE = 0.003  # [m], of fingers and of the face


def kind_of(name: str) -> Literal["body", "hand", "face"]:
    """What a keypoint belongs to: whose weight it has."""
    if name.startswith("face_"):
        return "face"
    return "hand" if any(part in name for part in FINGERS) else "body"


def lasting_of(names: tuple[str, ...]) -> Float[Tensor, " keypoints"]:
    """The prior standard deviation of each keypoint's lasting offset [m]."""
    return torch.tensor([
        LASTING.get(name.rpartition("_")[2], OTHERS) if kind_of(name) == "body" else FINE
        for name in names
    ])  # fmt: skip
