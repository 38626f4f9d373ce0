"""A few vertices of a body model, so that posing many bodies again and again is cheap."""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..types import BodyPose
from . import BodyModel
from .skinning import SkinnedBody
from .smpl_model import SmplBody


def thinned(model: BodyModel, index: Int[Tensor, " picked"]) -> BodyModel:
    """The model with these vertices only, and without faces; its joints and poses are the same.

    Raises:
        ValueError: If it is no skinned model.
    """
    match model:
        case SkinnedBody():
            return _skin(model, index)
        case SmplBody():
            return dataclasses.replace(
                model, skin=_skin(model.skin, index), pose_dirs=model.pose_dirs[:, index],
                expression_dirs=model.expression_dirs[index], face=None,
            )  # fmt: skip
        case _:
            raise ValueError(f"thinned: '{model.name}' is none of the skinned body models")


def _skin(model: SkinnedBody, index: Int[Tensor, " picked"]) -> SkinnedBody:
    return dataclasses.replace(
        model, faces=model.faces[:0], verts=model.verts[index], weights=model.weights[index],
        shape_dirs=model.shape_dirs[index],
    )  # fmt: skip


def spread(verts: Float[Tensor, "verts 3"], count: int) -> Int[Tensor, " picked"]:
    """Vertices that lie evenly over a mesh: each next one is the farthest from those before."""
    count = min(count, len(verts))
    chosen = torch.zeros(count, dtype=torch.long, device=verts.device)
    nearest = torch.full_like(verts[:, 0], torch.inf)
    for k in range(1, count):  # each choice depends on those before it
        apart = (verts - verts[chosen[k - 1]]).square().sum(-1)
        nearest = torch.minimum(nearest, apart)
        chosen[k] = nearest.argmax()
    return chosen.sort().values


def pose_rows(pose: BodyPose, rows: Int[Tensor, " rows"]) -> BodyPose:
    """Some rows of parameters."""
    return dataclasses.replace(
        pose, betas=pose.betas[rows], global_orient=pose.global_orient[rows],
        body_pose=pose.body_pose[rows], transl=pose.transl[rows],
        extra={name: value[rows] for name, value in pose.extra.items()},
    )  # fmt: skip
