"""Rays and the floor, and objects under a new camera."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..types import Layout
from .camera import to_camera, to_world

LOWEST = 0.02  # how much a ray of unit depth must go down at least to meet the floor


def hit_floor(
    rays_cam: Float[Tensor, "*batch 3"],
    R_cam_world: Float[Tensor, "3 3"],
    ground: Float[Tensor, ""],
) -> Float[Tensor, "*batch 3"]:
    """Where rays from the camera meet the floor, in the world [m].

    Rays near or above the horizon are held at the nearest direction that still goes down.
    """
    rays = to_world(rays_cam, R_cam_world)
    reach = -ground / (-rays[..., 1]).clamp_min(LOWEST)
    floor = ground.expand(reach.shape)
    return torch.stack([rays[..., 0] * reach, floor, rays[..., 2] * reach], -1)


def recast(
    layout: Layout,
    heights: Float[Tensor, " objects"],
    old: Float[Tensor, "3 3"],
    new: Float[Tensor, "3 3"],
) -> Layout:
    """The layout under a new camera (FORMAT.md, "a new camera").

    Each object keeps its box centre in the camera frame; its front is projected onto the new
    horizontal plane.

    Args:
        layout: Places in the old world.
        heights: Height of each box [m].
        old: R_cam_world of the old world.
        new: R_cam_world of the new world.
    """
    half = torch.zeros_like(layout.t_world_object)
    half[..., 1] = heights * layout.log_scale[..., 1].exp() / 2
    center = to_world(to_camera(layout.t_world_object + half, old), new)
    zero = torch.zeros_like(layout.yaw)
    front = torch.stack([layout.yaw.sin(), zero, layout.yaw.cos()], -1)
    front = to_world(to_camera(front, old), new)
    return Layout(center - half, torch.atan2(front[..., 0], front[..., 2]), layout.log_scale)


def slide_to_floor(
    layout: Layout, ground: float, standing: Bool[Tensor, " objects"], limit: float = 2.0
) -> Layout:
    """Move standing objects along their rays to the floor, keeping their size in the image.

    Objects whose base is not below the camera are left alone; sizes change at most by `limit`.
    """
    t = layout.t_world_object
    below = standing & (t[..., 1] < -1e-3)
    factor = torch.where(below, ground / t[..., 1].clamp_max(-1e-3), 1.0)
    factor = factor.clamp(1 / limit, limit).unsqueeze(-1)
    return Layout(t * factor, layout.yaw, layout.log_scale + factor.log())
