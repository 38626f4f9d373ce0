"""Rays and the floor, and objects under a new camera."""

import dataclasses
import itertools
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import Layout, Mesh, SceneObject
from mover.geometry.camera import to_camera, to_world
from mover.geometry.rotations import rot_y

ENDLESS = 2**40  # [frames], later than every other
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


def larger(layout: Layout, factor: float) -> Layout:
    """The layout of a room that is larger by a factor about the camera; the image is the same."""
    return Layout(layout.t_world_object * factor, layout.yaw, layout.log_scale + math.log(factor))


def reproject(
    layout: Layout,
    heights: Float[Tensor, " objects"],
    old: Float[Tensor, "3 3"],
    new: Float[Tensor, "3 3"],
) -> Layout:
    """The layout under a new camera (FORMAT.md, "a new camera").

    Each object keeps its box centre in the camera frame; its front is projected onto the new
    horizontal plane.
    """
    half = torch.zeros_like(layout.t_world_object)
    half[..., 1] = heights * layout.log_scale[..., 1].exp() / 2
    center = to_world(to_camera(layout.t_world_object + half, old), new)
    zero = torch.zeros_like(layout.yaw)
    front = torch.stack([layout.yaw.sin(), zero, layout.yaw.cos()], -1)
    front = to_world(to_camera(front, old), new)
    return Layout(center - half, torch.atan2(front[..., 0], front[..., 2]), layout.log_scale)


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


def rest_on_support(
    layout: Layout,
    supports: Int[Tensor, " objects"],
    heights: Float[Tensor, " objects"],
    ground: float,
) -> Layout:
    """Eliminate the height of objects that stand on the ground [m] or on another object.

    `supports` are those of `Objects`, `heights` those of the boxes at their initial size [m].
    """
    t = layout.t_world_object
    tops = ground + heights * layout.log_scale[..., 1].exp()
    carried = tops[..., supports.clamp_min(0)]
    floor = torch.full_like(carried, ground)
    y = torch.where(supports == GROUND, floor, torch.where(supports == FREE, t[..., 1], carried))
    return Layout(torch.stack([t[..., 0], y, t[..., 2]], -1), layout.yaw, layout.log_scale)


def place_object(piece: SceneObject) -> Mesh:
    """The piece's mesh in the world: x_world = R_y(yaw) @ (scale * x_mesh) + t_world_object."""
    verts = (piece.mesh.verts * piece.scale) @ rot_y(piece.yaw).mT + piece.t_world_object
    return Mesh(verts, piece.mesh.faces)


@record
class StandingMesh:
    """A mesh in the world from a frame until another."""

    mesh: Mesh
    first: int = -ENDLESS
    end: int = ENDLESS  #: the first frame in which it is elsewhere

    def when(self, frame: Int[Tensor, " rows"]) -> Bool[Tensor, " rows"]:
        """Whether it stands there in each of some frames."""
        return (frame >= self.first) & (frame < self.end)


def standing_meshes(piece: SceneObject) -> tuple[StandingMesh, ...]:
    """An object wherever it stands, one after the other; one place for what is never moved."""
    if not piece.segments:
        return (StandingMesh(place_object(piece)),)
    firsts = [-ENDLESS, *(segment.frame for segment in piece.segments[1:])]
    ends = [*firsts[1:], ENDLESS]
    return tuple(
        StandingMesh(place_object(placed_at(piece, segment.frame)), first, end)
        for segment, first, end in zip(piece.segments, firsts, ends, strict=True)
    )


def changes(piece: SceneObject) -> list[int]:
    """Frames in which an object begins to move, and in which it begins to stand elsewhere."""
    pairs = itertools.pairwise(piece.segments)
    return [b.frame for a, b in pairs if b.mover is None or b.mover != a.mover]


def mover_at(piece: SceneObject, frame: int) -> int | None:
    """Who moves an object in a frame; None: it stands."""
    started = [segment for segment in piece.segments if segment.frame <= frame]
    return started[-1].mover if started else None


def placed_at(piece: SceneObject, frame: int) -> SceneObject:
    """An object where it stands in a frame: in its last segment that has started."""
    started = [segment for segment in piece.segments if segment.frame <= frame]
    if not started:
        return piece
    now = max(started, key=lambda segment: segment.frame)
    return dataclasses.replace(piece, t_world_object=now.t_world_object, yaw=now.yaw)
