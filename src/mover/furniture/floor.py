"""The height of the floor as a function of place: a plane, and the tops of steps and platforms.

Everything that asks how high the floor is under something asks `height_under`.
"""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Bodies, Proposal, Scene, SceneObject
from mover.furniture.library import STEP, canonical
from mover.geometry.mesh import box, used
from mover.geometry.rotations import rot_y

CELLS = 64  # along each side of a platform
REACH = 0.1  # [m] of a top over a point, at most, that may stand on it, else it is beside it
CERTAIN = 0.8  # certainty from which a proposed platform is one


@record
class Platform:
    """The top of a piece that people step onto."""

    place: Float[Tensor, "3"]
    """Origin of its mesh in the world [m]."""
    yaw: Float[Tensor, ""]
    low: Float[Tensor, "2"]
    """Lowest x and z in its own axes [m]."""
    high: Float[Tensor, "2"]
    tops: Float[Tensor, "x z"]
    """Height in the world of what is highest in each cell between them [m]."""


@record
class Floor:
    """A plane, and what stands on it to be stepped onto."""

    ground: float
    """Height of the plane [m]."""
    platforms: tuple[Platform, ...] = ()


def is_platform(category: str) -> bool:
    """Whether pieces of a category are part of the floor."""
    return canonical(category) == STEP


def floor_of(scene: Scene, proposals: Iterable[Proposal] = ()) -> Floor | None:
    """The floor of a room; a platform that is proposed is part of it where that is certain.

    None: nobody knows how high the floor is.
    """
    if scene.ground is None:
        return None
    sure = (one.object for one in proposals if one.certainty >= CERTAIN)
    pieces = (piece for piece in (*scene.objects, *sure) if is_platform(piece.category))
    return Floor(scene.ground, tuple(_platform(piece) for piece in pieces))


def _platform(piece: SceneObject) -> Platform:
    mesh = used(piece.mesh)
    verts = (mesh.verts * piece.scale).detach().cpu()
    low, high = (end[[0, 2]] for end in box(verts))
    share = (torch.arange(CELLS) + 0.5).to(verts) / CELLS
    x, z = (low + share[:, None] * (high - low)).unbind(-1)
    points = torch.cartesian_prod(x, z)
    tops = torch.full_like(points[:, 0], float(verts[:, 1].min()))
    for corners in verts[mesh.faces.cpu()].split(CELLS):  # bounds the memory of large meshes
        height, inside = _over(points, corners)
        tops = torch.maximum(tops, torch.where(inside, height, tops[:, None]).amax(1))
    place, yaw = piece.t_world_object.detach().cpu(), piece.yaw.detach().cpu()
    return Platform(place, yaw, low, high, tops.reshape(CELLS, CELLS) + place[1])


def _over(
    points: Float[Tensor, "points 2"], corners: Float[Tensor, "faces 3 3"]
) -> tuple[Float[Tensor, "points faces"], Bool[Tensor, "points faces"]]:
    """Height of triangles over points (x, z), and where a point is within one."""
    flat = corners[..., [0, 2]]
    edges = flat.roll(-1, 1) - flat
    way = points[:, None, None] - flat
    areas = edges[..., 0] * way[..., 1] - edges[..., 1] * way[..., 0]
    inside = (areas >= 0).all(-1) | (areas <= 0).all(-1)
    whole = areas.sum(-1)
    share = areas.roll(-1, -1) / torch.where(whole == 0, 1.0, whole)[..., None]
    return (share * corners[..., 1]).sum(-1), inside & (whole != 0)


def height_under(floor: Floor, points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any"]:
    """Height of the floor under points of the world [m].

    It is that of the highest top that is not more than `REACH`, or half a platform's height, over
    the point: a foot beside a platform whose place is a little wrong is not lifted onto it.
    """
    height = torch.full_like(points[..., 1], floor.ground, requires_grad=False)
    for top in floor.platforms:  # few
        here = points.detach()
        own = ((here - top.place.to(here)) @ rot_y(top.yaw).to(here))[..., [0, 2]]
        low, high = top.low.to(own), top.high.to(own)
        cell = (CELLS * (own - low) / (high - low).clamp_min(1e-9)).floor().long()
        inside = ((cell >= 0) & (cell < CELLS)).all(-1)
        x, z = cell.clamp(0, CELLS - 1).unbind(-1)
        there = top.tops.to(own)[x, z]
        reach = ((there - floor.ground) / 2).clamp(0, REACH)
        stands = inside & (there - reach <= here[..., 1])
        height = torch.where(stands, torch.maximum(height, there), height)
    return height


def height_under_bodies(floor: Floor, bodies: Bodies) -> Float[Tensor, " bodies"]:
    """Height of the floor under the lowest point of each body in the world [m]."""
    lowest = bodies.verts[..., 1].argmin(1)
    return height_under(floor, bodies.verts[torch.arange(len(lowest)), lowest])
