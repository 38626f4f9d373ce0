r"""Distances of people beyond keypoints: the floor, and that lying people do not move.

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

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, SIDES
from mover.bodies.skinning import SkinnedBody

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
