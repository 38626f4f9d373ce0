"""What each true object of a room is like: used by people or not, hidden or seen."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.camera import to_camera
from ..geometry.placement import place_piece
from ..geometry.raster import first_hit
from ..records import record
from ..types import Scene

WIDTH = 480  # [px] of the picture in which hidden shares are counted


@record
class Traits:
    """An object of the truth, for the rows of the tables."""

    id: str
    category: str
    touched: bool
    """People sit or lie on it, lean on it or lay a hand on it."""
    hidden: float
    """Share of what the image would show of it that other furniture hides; 1: all."""


def hidden_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels within the image that other objects hide."""
    alone = torch.stack(_depths(scene)) if scene.pieces else torch.zeros(0, 1, 1)
    covered = alone.isfinite()
    seen = covered & (alone <= alone.amin(0, keepdim=True)) if len(alone) else covered
    whole, left = covered.sum((1, 2)), seen.sum((1, 2))
    shares = torch.where(whole > 0, 1 - left / whole.clamp_min(1), torch.ones_like(whole).float())
    return tuple(round(share, 4) for share in shares.tolist())


def _depths(scene: Scene) -> list[Float[Tensor, "h w"]]:
    """Depth of each object drawn alone in a small picture [m], inf where it is not."""
    camera = scene.camera
    zoom = min(1.0, WIDTH / camera.width)
    size = (max(1, round(camera.height * zoom)), max(1, round(camera.width * zoom)))
    zooms = torch.tensor([size[1] / camera.width, size[0] / camera.height, 1.0]).to(camera.K)
    drawn: list[Tensor] = []
    for piece in scene.pieces:  # meshes differ in their number of triangles
        mesh = place_piece(piece)
        verts = to_camera(mesh.verts.to(camera.K), camera.R_cam_world)
        drawn.append(first_hit(verts, mesh.faces, camera.K * zooms[:, None], size)[0])
    return drawn
