"""Place objects in the world."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..types import Layout, Mesh, Piece
from .rotations import rot_y

GROUND, FREE = -1, -2


def place(
    points: Float[Tensor, "objects points 3"], layout: Layout
) -> Float[Tensor, "*starts objects points 3"]:
    """Move points from object frames to the world [m]."""
    scaled = points * layout.log_scale.exp().unsqueeze(-2)
    return scaled @ rot_y(layout.yaw).mT + layout.t_world_object.unsqueeze(-2)


def place_in(
    points: Float[Tensor, "objects points 3"], layout: Layout, R_cam_world: Float[Tensor, "3 3"]
) -> Float[Tensor, "*starts objects points 3"]:
    """Move points from object frames into camera axes, by one matrix an object [m]."""
    turn = R_cam_world @ rot_y(layout.yaw) * layout.log_scale.exp().unsqueeze(-2)
    origin = layout.t_world_object @ R_cam_world.mT
    return points @ turn.mT + origin.unsqueeze(-2)


def stand(
    layout: Layout,
    supports: Int[Tensor, " objects"],
    heights: Float[Tensor, " objects"],
    ground: float,
) -> Layout:
    """Eliminate the height of objects that stand on the ground or on another object.

    Args:
        layout: Places whose y counts only for free objects.
        supports: As in `Objects.supports`.
        heights: Height of each object's box at its initial size [m].
        ground: Height of the floor [m].
    """
    t = layout.t_world_object
    tops = ground + heights * layout.log_scale[..., 1].exp()
    carried = tops[..., supports.clamp_min(0)]
    floor = torch.full_like(carried, ground)
    y = torch.where(supports == GROUND, floor, torch.where(supports == FREE, t[..., 1], carried))
    return Layout(torch.stack([t[..., 0], y, t[..., 2]], -1), layout.yaw, layout.log_scale)


def place_piece(piece: Piece) -> Mesh:
    """The piece's mesh in the world: x_world = R_y(yaw) @ (scale * x_mesh) + t_world_object."""
    verts = (piece.mesh.verts * piece.scale) @ rot_y(piece.yaw).mT + piece.t_world_object
    return Mesh(verts, piece.mesh.faces)
