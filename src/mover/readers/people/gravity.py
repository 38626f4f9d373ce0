"""Gravity: which way is up in the camera, as the tools' own worlds tell it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from ...geometry.camera import tilted
from ...geometry.rotations import axis_angle

TURNED = math.radians(5)  # cameras whose up-vectors spread more are not taken to stand still
TRAVELLED = 0.1  # [m], the same for their places


def up_of_roots(
    root_cam: Float[Tensor, "bodies 3"], root_world: Float[Tensor, "bodies 3"]
) -> Float[Tensor, "bodies 3"]:
    """Up in the camera, from one body's root in camera axes and in a world with +y up."""
    R_cam_world = axis_angle(root_cam.double()) @ axis_angle(root_world.double()).mT
    return R_cam_world[..., 1].float()


def mean_up(up: Float[Tensor, "bodies 3"]) -> tuple[Float[Tensor, "3"] | None, float]:
    """The one direction that a camera at rest has, and the spread about it [rad].

    The middle is the normalised median; the spread is the angle that nine of ten keep. None where
    no row tells it.
    """
    known = up[up.isfinite().all(-1) & (up.norm(dim=-1) > 0)].double()
    if not len(known):
        return None, 0.0
    middle = torch.nn.functional.normalize(known.median(0).values, dim=0)
    cosine = torch.nn.functional.normalize(known, dim=-1) @ middle
    spread = cosine.clamp(-1, 1).acos().quantile(0.9)
    return middle.float(), float(spread)


def level(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """R_cam_world of the camera that sees this as up, without heading."""
    x, y, z = (up / up.norm()).unbind()
    return tilted(z.clamp(-1, 1).asin(), torch.atan2(-x, -y))


def movement(
    R_cam_world: Float[Tensor, "frames 3 3"], t: Float[Tensor, "frames 3"]
) -> tuple[str, ...]:
    """A warning if the camera of a tool (x_cam = R x + t) does not stand still."""
    if len(R_cam_world) < 2:
        return ()
    R, shift = R_cam_world.double(), t.double()
    turn = R @ R[:1].mT
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = float(cosine.clamp(-1, 1).acos().max())
    centre = -(R.mT @ shift[..., None])[..., 0]
    way = float((centre - centre[0]).norm(dim=-1).max())
    if angle < TURNED and way < TRAVELLED:
        return ()
    told = f"turns by up to {math.degrees(angle):.1f} degrees and travels {way:.2f} m"
    return (f"the camera {told}; rooms are rebuilt from a camera that stands still",)
