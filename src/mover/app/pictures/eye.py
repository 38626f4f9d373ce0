"""Eyes: pinhole cameras anywhere in the world, to look at a room from."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from mover.core.records import record
from mover.core.types import Camera

FIELD = math.radians(42)  # [rad], height of the field of view of an eye that is not the video's
ABOVE = math.radians(20)  # [rad], height of the field of view from above: nearly a plan
MARGIN = 1.06  # free border around what an eye is to see


@record
class RenderCamera:
    """A pinhole camera anywhere (x right, y down, z forward)."""

    K: Float[Tensor, "3 3"]
    """Intrinsics [px]."""
    R_eye_world: Float[Tensor, "3 3"]
    t_world_eye: Float[Tensor, "3"]
    """Where it is [m]."""
    width: int
    """[px]"""
    height: int
    """[px]"""

    def finer(self, factor: int) -> "RenderCamera":
        """The same view in pictures of more pixels."""
        K = self.K * torch.tensor([factor, factor, 1.0])[:, None]
        size = factor * self.width, factor * self.height
        return RenderCamera(K, self.R_eye_world, self.t_world_eye, *size)


def video_eye(camera: Camera, width: int) -> RenderCamera:
    """The eye of the video in pictures `width` pixels wide, which are even in width and height."""
    width -= width % 2
    return camera_sized(camera, width, max(2, 2 * round(width * camera.height / camera.width / 2)))


def camera_sized(camera: Camera, width: int, height: int) -> RenderCamera:
    """The video's camera with pictures of another size [px]."""
    zoom = torch.tensor([width / camera.width, height / camera.height, 1.0])
    K = camera.K.detach().float() * zoom[:, None]
    return RenderCamera(K, camera.R_cam_world.detach().float(), torch.zeros(3), width, height)


def above_eye(points: Float[Tensor, "points 3"], size: tuple[int, int]) -> RenderCamera:
    """An eye straight above, away from the video's camera upwards, that sees all points.

    Args:
        points: In the world [m].
        size: Width and height of its pictures [px].
    """
    return orbit_eye(points, size, 0.0, math.pi / 2, ABOVE)


def orbit_eye(
    points: Float[Tensor, "points 3"],
    size: tuple[int, int],
    azimuth: float,
    elevation: float,
    field: float = FIELD,
) -> RenderCamera:
    """An eye somewhere around the room, as near to the middle as it may be to see all points.

    Args:
        points: In the world [m].
        size: Width and height of its pictures [px].
        azimuth: 0 is the video's side, pi / 2 the right of its image [rad].
        elevation: 0 is level, pi / 2 straight above [rad].
        field: Height of its field of view [rad].
    """
    (width, height), flat = size, math.cos(elevation)
    out = [math.sin(azimuth) * flat, math.sin(elevation), math.cos(azimuth) * flat]
    away, right = torch.tensor(out), torch.tensor([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    down = normalize(torch.linalg.cross(-away, right), dim=0)
    R_eye_world = torch.stack([right, down, -away])
    focal = height / 2 / math.tan(field / 2)
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    middle = (points.amin(0) + points.amax(0)) / 2
    x, y, z = ((points - middle) @ R_eye_world.mT).unbind(-1)
    reach = MARGIN * torch.maximum(x.abs() * focal * 2 / width, y.abs() * focal * 2 / height)
    far = float((reach - z).amax().clamp_min(1.0))
    return RenderCamera(K, R_eye_world, middle + far * away, width, height)


def spinning_eyes(
    points: Float[Tensor, "points 3"],
    size: tuple[int, int],
    azimuths: Sequence[float],
    elevation: float,
) -> list[RenderCamera]:
    """Eyes on a circle around the room, all at the distance of the farthest."""
    middle = (points.amin(0) + points.amax(0)) / 2
    eyes = [orbit_eye(points, size, azimuth, elevation) for azimuth in azimuths]
    far = max(float((eye.t_world_eye - middle).norm()) for eye in eyes)
    return [
        RenderCamera(eye.K, eye.R_eye_world, middle - far * eye.R_eye_world[2], *size)
        for eye in eyes
    ]


def in_eye(eye: RenderCamera, points_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """World points in the axes of the eye [m]."""
    return (points_world - eye.t_world_eye) @ eye.R_eye_world.mT


def floor_points(eye: RenderCamera, height: float) -> Float[Tensor, "h w 3"]:
    """Where the ray of each pixel meets the plane y = `height` [m]; inf where it never does."""
    rows, columns = torch.arange(eye.height) + 0.5, torch.arange(eye.width) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(eye.K).mT
    rays = rays @ eye.R_eye_world
    fall = height - eye.t_world_eye[1]
    along = fall / torch.where(rays[..., 1].abs() < 1e-6, 1e-6, rays[..., 1])
    points = eye.t_world_eye + rays * along[..., None]
    return torch.where((along > 0)[..., None], points, torch.inf)
