"""Rotations: about the axes of the world, from axis-angle vectors, and between sets of points."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def rot_x(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Right-handed rotations about +x; `angle` in [rad]."""
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([i, o, o, o, c, -s, o, s, c], -1).reshape(*angle.shape, 3, 3)


def rot_y(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Right-handed rotations about +y; `angle` in [rad]."""
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, o, s, o, i, o, -s, o, c], -1).reshape(*angle.shape, 3, 3)


def rot_z(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3 3"]:
    """Right-handed rotations about +z; `angle` in [rad]."""
    c, s, o, i = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, i], -1).reshape(*angle.shape, 3, 3)


def axis_angle(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angle vectors [rad] (Rodrigues), smooth at zero."""
    x, y, z = vector.unbind(-1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*vector.shape[:-1], 3, 3)
    squared = vector.square().sum(-1)[..., None, None]
    small = squared < 1e-8
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    second = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / angle.square())
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return eye + first * skew + second * (skew @ skew)


def rotation_vectors(turns: Float[Tensor, "rows 3 3"]) -> Float[Tensor, "rows 3"]:
    """Axis-angle vectors of rotation matrices [rad]; nothing is differentiated."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(turns.detach().cpu().double().numpy()).as_rotvec()
    return torch.from_numpy(found).to(turns)


def affine(
    A: Float[np.ndarray, "*batch 3 3"], t: Float[np.ndarray, "*batch 3"] | float = 0.0
) -> Float[np.ndarray, "*batch 4 4"]:
    """The matrices of A x + t, in double precision."""
    out = np.tile(np.eye(4), (*A.shape[:-2], 1, 1))
    out[..., :3, :3], out[..., :3, 3] = A, t
    return out


def similarity(
    start: Float[Tensor, "*batch points 3"], end: Float[Tensor, "*batch points 3"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch 3 3"], Float[Tensor, "*batch 3"]]:
    """Size, rotation and shift that bring points nearest to others (Umeyama); never a mirror."""
    a, b = start.mean(-2, keepdim=True), end.mean(-2, keepdim=True)
    u, s, vt = torch.linalg.svd((end - b).mT @ (start - a))
    flip = torch.ones_like(s)
    flip[..., 2] = torch.where(torch.linalg.det(u @ vt) < 0, -1.0, 1.0)
    turn = u @ (flip[..., None] * vt)
    spread = (start - a).square().sum((-2, -1)).clamp_min(torch.finfo(start.dtype).tiny)
    size = (s * flip).sum(-1) / spread
    return size, turn, (b - size[..., None, None] * a @ turn.mT).squeeze(-2)


def wrap(angle: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same angle in (-pi, pi] [rad]."""
    return torch.atan2(angle.sin(), angle.cos())
