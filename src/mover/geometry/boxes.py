"""Upright boxes in the world, and how much of them two boxes share."""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import SceneObject
from mover.geometry.mesh import box, used
from mover.geometry.rotations import rot_y


@record
class Box:
    """Upright boxes: turned about the vertical only."""

    center: Float[Tensor, "*b 3"]  #: middle of the box in the world [m]
    size: Float[Tensor, "*b 3"]  #: full edges along the box's own axes [m]
    yaw: Float[Tensor, "*b"]  #: right-handed rotation about +y [rad]


def box_of(piece: SceneObject) -> Box:
    """The placed box of a piece: of the vertices that its faces use, in the mesh's own axes."""
    low, high = box(used(piece.mesh).verts)
    center = rot_y(piece.yaw) @ (piece.scale * (low + high) / 2) + piece.t_world_object
    return Box(center, piece.scale.abs() * (high - low), piece.yaw)


def corners(of: Box) -> Float[Tensor, "*b 8 3"]:
    """Corners in the world [m]; number 4 i + 2 j + k has the sign i of x, j of y, k of z (1: +)."""
    unit = torch.tensor([-0.5, 0.5], dtype=of.size.dtype, device=of.size.device)
    local = torch.cartesian_prod(unit, unit, unit) * of.size.unsqueeze(-2)
    return local @ rot_y(of.yaw).mT + of.center.unsqueeze(-2)


def beyond(of: Box, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 2"]:
    """How far points of the world are outside of a box's footprint, along its own x and z [m].

    Negative: between the two edges of that axis.
    """
    return ((points - of.center) @ rot_y(of.yaw)).abs()[..., [0, 2]] - of.size[[0, 2]] / 2


def iou3d(a: Box, b: Box) -> Float[Tensor, "*b"]:
    """Shared volume over joint volume of upright boxes; 0 where both are empty."""
    (low, high), (bottom, top) = _ends(a), _ends(b)
    overlap = torch.minimum(high, top) - torch.maximum(low, bottom)
    shared = _shared_footprint(a, b) * overlap.clamp_min(0)
    joint = a.size.double().prod(-1) + b.size.double().prod(-1) - shared
    return (shared / joint.clamp_min(torch.finfo(torch.float64).tiny)).to(a.size.dtype)


def iou2d(a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b"]:
    """Shared area over joint area of image boxes x_min, y_min, x_max, y_max [px]."""
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    shared = (high - low).clamp_min(0).prod(-1)
    joint = _area(a) + _area(b) - shared
    return shared / joint.clamp_min(torch.finfo(joint.dtype).tiny)


def _area(box: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b"]:
    return (box[..., 2:] - box[..., :2]).clamp_min(0).prod(-1)


def _ends(box: Box) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    """Lowest and highest y [m]."""
    middle, half = box.center[..., 1].double(), box.size[..., 1].double() / 2
    return middle - half, middle + half


def _shared_footprint(a: Box, b: Box) -> Float[Tensor, "*b"]:
    """Area that the two rectangles seen from above share [m²]."""
    ring = torch.tensor([[-1.0, -1], [-1, 1], [1, 1], [1, -1]], dtype=torch.float64) / 2
    flat = torch.tensor([0, 2], device=b.size.device)
    local = ring.to(b.size.device) * b.size.double()[..., None, flat]
    polygon = _turned(local, b.yaw.double() - a.yaw.double())
    offset = (b.center - a.center).double()[..., None, flat]
    polygon = polygon + _turned(offset, -a.yaw.double())
    for axis in (0, 1):
        for side in (1, -1):
            polygon = _clipped(polygon, axis, side, a.size.double()[..., flat[axis]] / 2)
    x, z = polygon.unbind(-1)
    return (x * z.roll(-1, -1) - z * x.roll(-1, -1)).sum(-1).abs() / 2


def _turned(points: Float[Tensor, "*b n 2"], yaw: Float[Tensor, "*b"]) -> Float[Tensor, "*b n 2"]:
    """Points (x, z) turned by the right-handed rotation about +y [rad]."""
    cos, sin = yaw.cos()[..., None], yaw.sin()[..., None]
    x, z = points.unbind(-1)
    return torch.stack([cos * x + sin * z, cos * z - sin * x], -1)


def _clipped(
    polygon: Float[Tensor, "*b n 2"], axis: int, side: int, limit: Float[Tensor, "*b"]
) -> Float[Tensor, "*b twice 2"]:
    """The part of a polygon where side * coordinate <= limit, with twice the vertices.

    Vertices beyond the limit move straight onto it, and every edge gains its point on the limit
    (or its own start, where it has none): what runs along the limit encloses nothing, so that
    the area is exact without any test of equality.
    """
    following = polygon.roll(-1, -2)
    here, there = side * polygon[..., axis], side * following[..., axis]
    limit = limit[..., None]
    crosses = (here > limit) != (there > limit)
    share = torch.where(crosses, (limit - here) / torch.where(crosses, there - here, 1.0), 0.0)
    along = torch.arange(2, device=polygon.device) == axis
    start = torch.where(along, side * torch.minimum(here, limit)[..., None], polygon)
    middle = polygon + share[..., None] * (following - polygon)
    held = side * torch.minimum(side * middle[..., axis], limit)
    middle = torch.where(along, held[..., None], middle)
    return torch.stack([start, middle], -2).flatten(-3, -2)
