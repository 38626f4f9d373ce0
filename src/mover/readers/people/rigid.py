"""Parameters of bodies: posed, and moved as rigid bodies, whose root turns about the pelvis."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from ...bodies import BodyModel, load_model
from ...geometry.rotations import axis_angle
from ...types import BodyPose
from ..fields import At
from .found import chosen_pose
from .values import vectors

NO_TURN = 1e-6
CHUNK = 128  # rows posed at once


def run_model(
    model: BodyModel, pose: BodyPose
) -> tuple[Float[Tensor, "bodies verts 3"], Float[Tensor, "bodies joints 3"]]:
    """Vertices and joints, some rows at a time to bound the memory [m]."""
    with torch.no_grad():
        parts = [
            model.posed(chosen_pose(pose, index))
            for index in torch.arange(len(pose.transl)).split(CHUNK)
        ]
    return torch.cat([verts for verts, _ in parts]), torch.cat([joints for _, joints in parts])


def rest_pelvis(model: BodyModel, pose: BodyPose) -> Float[Tensor, "bodies 3"]:
    """From `transl` to the pelvis, about which the root turns [m]."""
    straight = dataclasses.replace(
        pose,
        transl=torch.zeros_like(pose.transl),
        global_orient=torch.zeros_like(pose.global_orient),
    )
    return run_model(model, straight)[1][:, 0]


def moved(pose: BodyPose, R: Float[Tensor, "bodies 3 3"], t: Float[Tensor, "bodies 3"]) -> BodyPose:
    """The parameters of the bodies x' = R x + t.

    Raises:
        InputError: If the body turns and its model, which knows the pelvis, is not at hand.
    """
    if (R - torch.eye(3).to(R)).abs().nan_to_num(0).amax() < NO_TURN:
        return dataclasses.replace(pose, transl=pose.transl + t)
    offset = rest_pelvis(load_model(pose.model, pose.gender), pose)
    place = (R @ (offset + pose.transl)[..., None])[..., 0] + t - offset
    return dataclasses.replace(pose, transl=place, global_orient=turned(pose.global_orient, R))


def turned(root: Float[Tensor, "bodies 3"], R: Float[Tensor, "bodies 3 3"]) -> Tensor:
    """Axis-angle vectors of roots that are turned by R; NaN stays NaN [rad]."""
    whole = (R.double() @ axis_angle(root.double())).numpy()
    return torch.from_numpy(vectors(whole, At(whole, "the camera"))).to(root)
