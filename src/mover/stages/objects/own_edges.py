"""Direction of each object, estimated from its own straight edges in the image.

Not in the paper. Beds, tables and shelves are square, and most of their edges level or upright: a
level one constrains the yaw of its object up to quarter turns, whatever the shape of its mesh. The
edge lies in the plane through the camera and its picture, and runs where that meets a level plane.
Upright edges constrain nothing, and slanted ones are wrong, each in its own way: as for the axis of
the room, each edge may be one of those, and edges that agree are trusted.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from mover.core.records import record
from mover.core.types import Camera
from mover.geometry.rotations import wrap
from mover.stages.camera.room_lines import Segments

BORDER = 3  # [px], how far off a mask edges are its own, too: outlines
UPRIGHT = math.radians(10)  # how far from upright the planes of edges must be that may be level


@record
class OwnEdges:
    """Edges of furniture that may be level."""

    of: Int[Tensor, " edges"]
    """The object of each."""
    yaw: Float[Tensor, " edges"]
    """Where it runs if it is level, up to half turns [rad]."""
    spread: Float[Tensor, " edges"]
    """Standard deviation [rad]."""


def own_edges(
    segments: Segments,
    masks: Bool[Tensor, "objects h w"],
    people: Bool[Tensor, "h w"],
    camera: Camera,
) -> OwnEdges:
    """The straight edges of each object, and where they run."""
    of = _owners(segments, masks, people, camera)
    yaw, upright = _level(segments, camera, 0.0)
    turned = torch.stack([_level(segments, camera, errors)[0] for errors in (-1.0, 1.0)])
    spread = wrap(2 * (turned - yaw)).abs().amax(0) / 2  # half turns aside
    level = (of >= 0) & ~upright
    return OwnEdges(of[level], yaw[level].float(), spread[level].float())


def _owners(
    segments: Segments,
    masks: Bool[Tensor, "objects h w"],
    people: Bool[Tensor, "h w"],
    camera: Camera,
) -> Int[Tensor, " edges"]:
    """Whose edge each is; -1: of no object, of several, or of people."""
    x, y = (segments.middle + camera.K[:2, 2].double().cpu()).long().unbind(-1)
    beside = torch.arange(-BORDER, BORDER + 1)
    x = (x[:, None, None] + beside).clamp(0, camera.width - 1)
    y = (y[:, None, None] + beside[:, None]).clamp(0, camera.height - 1)
    near = masks[:, y, x].flatten(2).any(-1).cpu()
    alone = (near.sum(0) == 1) & ~people[y, x].flatten(1).any(-1).cpu()
    return torch.where(alone, near.int().argmax(0), -1)


def _level(
    segments: Segments, camera: Camera, errors: float
) -> tuple[Float[Tensor, " edges"], Bool[Tensor, " edges"]]:
    """Yaw of each edge if it is level, turned in the picture by so many errors of its angle.

    And whether it may as well be upright.
    """
    angle, focal = errors * segments.error, camera.K[0, 0].double().cpu()
    x, y = segments.along.unbind(-1)
    x, y = angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y
    along = torch.stack([x, y, torch.zeros_like(x)], -1)
    ray = torch.cat([segments.middle, focal.expand(len(x), 1)], -1)
    normal = torch.linalg.cross(ray, along) @ camera.R_cam_world.double().cpu()
    normal = normalize(normal, dim=-1)
    return torch.atan2(normal[:, 2], -normal[:, 0]), normal[:, 1].abs() < math.sin(UPRIGHT)
