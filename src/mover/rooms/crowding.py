"""How much of each piece of furniture other pieces hide, in a small picture without people."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.camera import to_camera
from ..geometry.raster import first_hit
from ..types import Camera
from .placed import Placed, verts_on_floor

WIDTH = 240  # [px] of the small picture
HIDDEN = 0.3  # a piece of which more is hidden counts as hidden


def depth_of(piece: Placed, camera: Camera, height: float) -> Float[Tensor, "h w"]:
    """Depth of a piece drawn alone by a camera above the floor [m], infinite where it is not."""
    zoom = WIDTH / camera.width
    size = (max(1, round(camera.height * zoom)), WIDTH)
    K = camera.K * torch.tensor([[zoom], [size[0] / camera.height], [1.0]])
    verts = torch.from_numpy(verts_on_floor(piece)).float() - torch.tensor([0, height, 0])
    cam = to_camera(verts, camera.R_cam_world)
    return first_hit(cam, piece.furniture.mesh.faces, K, size)[0]


def worth(depths: list[Float[Tensor, "h w"]], least: float, most: float) -> float:
    """How many pieces others hide well, plus a little; -1 where one can hardly be seen.

    Args:
        depths: Of each piece drawn alone [m].
        least: Fewest pixels of the small picture that a piece must show.
        most: No piece may be hidden more than this share.
    """
    alone = torch.stack(depths)
    covered = alone.isfinite()
    seen = (covered & (alone <= alone.amin(0))).sum((1, 2)).numpy()
    hidden = 1 - seen / covered.sum((1, 2)).clamp_min(1).numpy()
    if (hidden > most).any() or (seen < least).any():
        return -1.0
    return float((hidden >= HIDDEN).sum() + 0.1 * hidden.mean())
