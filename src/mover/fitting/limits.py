"""How far joints turn: a pose prior from anatomy, which needs no file of anybody.

    E_pose(θ) = Σ_k ((θ_k - rest_k) / spread_k)² + Σ_k (stiffness · excess_k)²

θ are axis-angle components of the 21 joints of the body about the axes of the T-pose (+x to the
person's left, +y up, +z to the front). Ranges are the normal ranges of motion of the American
Academy of Orthopaedic Surgeons ("Joint Motion", 1965) and of Kapandji ("The Physiology of the
Joints"), rounded; ranges of spine and neck are shared among their joints. Rest and spread are ours:
a person with hanging arms, and half of the range that daily life uses.
"""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.skeleton import BODY

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


def limits_of(joint: str) -> tuple[Range, Range, Range]:
    """Limits, rest and spread of a joint of the body about x, y and z [degrees]."""
    if joint in MIDDLE:
        return MIDDLE[joint]
    side, name = joint.split("_")
    x, y, z = LEFT[name]
    return (x, y, z) if side == "left" else (x, _mirrored(y), _mirrored(z))


def _mirrored(limit: Range) -> Range:
    low, high, rest, spread = limit
    return (-high, -low, -rest, spread)


@lru_cache(maxsize=1)
def limit_table() -> Float[Tensor, "4 63"]:
    """Lowest, highest, rest and spread of all angles of the body [rad]."""
    rows = [axis for name in BODY[1:] for axis in limits_of(name)]
    return torch.deg2rad(torch.tensor(rows, dtype=torch.float64)).mT.contiguous()


def limit_cost(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, " bodies"]:
    """Squared excess over the ranges of motion, in units of `1 / STIFFNESS`; 0 within them."""
    low, high, _, _ = limit_table().to(angles)
    body = angles[:, :63]
    excess = (low - body).clamp_min(0) + (body - high).clamp_min(0)
    return (excess * STIFFNESS).square().sum(-1)


def resting(bodies: int, like: Tensor) -> Float[Tensor, "bodies 63"]:
    """A standing person with hanging arms [rad]."""
    return limit_table()[2].to(like).expand(bodies, -1).clone()


def spreads(bodies: int, like: Tensor, loose: tuple[str, ...] = ()) -> Float[Tensor, "bodies 63"]:
    """How far each angle is from its rest in daily life [rad].

    Args:
        bodies: Number of identical rows.
        like: For type and device.
        loose: Joints that may be anywhere: the deviation of what is uniform in their ranges.
    """
    low, high, _, spread = limit_table().to(like)
    free = torch.tensor([any(name in joint for name in loose) for joint in BODY[1:]])
    free = free.repeat_interleave(3).to(like.device)
    return torch.where(free, (high - low) / math.sqrt(12), spread).expand(bodies, -1)
