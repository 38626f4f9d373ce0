"""The skin of a body model on the bones of a result's people, for formats that have bones."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skinning import SkinnedBody
from mover.core.records import record
from mover.core.types import Bodies
from mover.io.export.finished import Finished
from mover.io.export.people import tracks_of
from mover.io.export.posed import Motion, misses, motion_of, skin_of

SKIN_MISS = 0.02  # [m], the most that a skinned body may miss the result's mesh


@record
class Skin:
    """Bones of everybody, each person with one shape."""

    motion: Motion
    model: SkinnedBody
    """With as many weights a vertex as the format draws."""
    miss: float
    """How far the skin is off the meshes of the result at most [m]."""


def skin_for(finished: Finished, influences: int) -> Skin | str:
    """The bones that move the result's bodies, or why there are none.

    Args:
        finished: The result.
        influences: Joints that may move a vertex.
    """
    motion = motion_of(finished)
    if isinstance(motion, str):
        return motion
    assert finished.bodies is not None
    model = skin_of(motion.pose, finished.bodies)
    if model is None:
        return f"the model {motion.pose.model!r} has no bones that are known here"
    skin = _fit(motion, model, finished.bodies, influences)
    if not skin.miss <= SKIN_MISS:
        return f"its bones miss the result's meshes by {skin.miss:.3f} m"
    return skin


def _fit(motion: Motion, model: SkinnedBody, bodies: Bodies, influences: int) -> Skin:
    """One shape for each person, few weights for each vertex, and what they cost."""
    share, joint = model.weights.topk(influences, dim=1)
    weights = torch.zeros_like(model.weights).scatter(1, joint, share / share.sum(1, keepdim=True))
    simple = dataclasses.replace(model, weights=weights)
    betas = motion.pose.betas.clone()
    for track in tracks_of(bodies):
        betas[track.rows] = betas[track.rows].mean(0)
    posed = Motion(dataclasses.replace(motion.pose, betas=betas), motion.size)
    return Skin(posed, simple, misses(posed, simple, bodies))


def rest_of(skin: Skin, row: int) -> tuple[Float[Tensor, "verts 3"], Float[Tensor, "joints 3"]]:
    """Skin and joints of a row's person in the rest shape [m]."""
    betas, model = skin.motion.pose.betas[row], skin.model
    count = len(betas)
    verts = model.verts + model.shape_dirs[..., :count] @ betas
    return verts, model.joints + model.joint_dirs[..., :count] @ betas


def quaternions(vectors: Float[Tensor, "frames joints 3"]) -> NDArray[np.float32]:
    """Rotations (x, y, z, w) of axis-angle vectors; neighbours in time are on one side."""
    angle = vectors.double().norm(dim=-1, keepdim=True)
    half = torch.where(angle > 1e-9, (angle / 2).sin() / angle.clamp_min(1e-9), 0.5)
    found = torch.cat([vectors.double() * half, (angle / 2).cos()], -1)
    dots = (found[1:] * found[:-1]).sum(-1)
    side = torch.where(dots < 0, -1.0, 1.0).cumprod(0)
    return torch.cat([found[:1], found[1:] * side[..., None]]).float().numpy()
