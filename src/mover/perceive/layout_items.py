"""Things and their possible shapes as items that are screened and placed all at once."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..energy import ImageCues
from ..geometry.mesh import box, used
from ..geometry.raster import Views
from ..types import Detection, Layout, Piece
from .candidates import Shape
from .screen import Screened, outermost

TURNED_APART = 0.6  # [rad], turns that are nearer count as one start


def outer_points(shape: Shape) -> Float[Tensor, "points 3"]:
    """The outermost points of a shape, from the centre of its bottom [m]."""
    verts = used(shape.mesh).verts
    low, high = box(verts)
    origin = torch.stack([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    return outermost(verts - origin).float()


def best_items(screened: Screened, owner: list[int], keep: int) -> list[int]:
    """The `keep` best shapes of each thing, in the order of the things, best first."""
    best = screened.energy.amin(0)
    found: list[int] = []
    for thing in sorted(set(owner)):
        own = [k for k, o in enumerate(owner) if o == thing]
        found += sorted(own, key=lambda k: float(best[k]))[:keep]
    return found


def starts_of(screened: Screened, items: list[int], turns: int) -> Layout:
    """The best turns of each item, spread so that both fronts of a box are tried."""
    yaw = screened.layout.yaw[:, items]
    energy = screened.energy[:, items]
    picks = torch.stack([_apart(yaw[:, k], energy[:, k], turns) for k in range(len(items))], 1)
    wide = picks[..., None].expand(-1, -1, 3)
    return Layout(
        screened.layout.t_world_object[:, items].gather(0, wide),
        yaw.gather(0, picks),
        screened.layout.log_scale[:, items].gather(0, wide),
    )


def _apart(yaw: Float[Tensor, " yaws"], energy: Tensor, turns: int) -> Int[Tensor, " turns"]:
    """Indices of the best turns that differ; the best of the rest fill up."""
    kept: list[int] = []
    rest: list[int] = []
    for k in energy.argsort().tolist():
        near = [abs(float(torch.remainder(yaw[k] - yaw[j] + torch.pi, 2 * torch.pi)) - torch.pi)
                for j in kept]  # fmt: skip
        (kept if all(d > TURNED_APART for d in near) else rest).append(k)
    return torch.tensor((kept + rest)[:turns])


def piece_of(detection: Detection, shape: Shape, name: str) -> Piece:
    """A shape at the origin, standing for a detection."""
    return Piece(
        id=name, category=detection.category, mesh=shape.mesh, mesh_file=shape.file,
        annotation=detection.id, support="ground", t_world_object=torch.zeros(3),
        yaw=torch.tensor(0.0), scale=torch.ones(3),
    )  # fmt: skip


def repeated(cues: ImageCues, things: Int[Tensor, " items"]) -> ImageCues:
    """The cues of each item's thing."""
    views = Views(cues.views.K[things], cues.views.height, cues.views.width)
    return ImageCues(
        cues.boxes[things], cues.sides[things], views, cues.masks[things], cues.keep[things],
        cues.trust[things],
    )  # fmt: skip
