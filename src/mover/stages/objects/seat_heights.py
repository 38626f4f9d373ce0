r"""Seats as high in their meshes as people sit and lie on them (not in the paper; its failure A).

The image tells how large a piece is, from its feet to the top of its back, and not how high its
seat is in between: that is inside the outline, and a mesh of another design has it elsewhere (7 cm
off, root mean square, in rooms where no mesh is the true one). Who sits tells it to 2.5 cm: the
lowest of the skin that carries them is the seat. So the middle of a mesh whose shape does not fit
is raised or lowered until its seat is there; feet and back stay where they are.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import Parts, members
from mover.bodies.posture import postures
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.types import Bodies, Layout, Objects
from mover.furniture.floor import Floor, height_under_bodies
from mover.geometry.placement import place
from mover.stages.config import BendConfig
from mover.stages.objects.room_scale import CARRIED, FEWEST

CARRIERS = (CARRIED, ("seat",))  # of who sits, who lies
TOLD = 0.025  # [m], usual error of the height of a seat as they tell it
LOWEST = 0.15  # share of their points below the top of what carries them
NEAR = 20  # points of a seat that are nearest to a body
BETWEEN = (0.15, 0.9)  # shares of the height of a piece between which a seat can be moved
MOST = 0.3  # of a piece's height, that its middle control points move


@record
class SeatInputs:
    """Furniture where it stands, who touches it, and whose seat may be elsewhere in its mesh."""

    objects: Objects
    layout: Layout
    bodies: Bodies
    """In the world."""
    parts: Parts
    floor: Floor
    pairs: Int[Tensor, "pairs 3"]
    """Who touches what: body, object, and part as in `ContactPoints.points`."""
    loose: Bool[Tensor, " objects"]
    """Whose shapes do not fit."""


@record
class SeatHeights:
    """How much higher seats are than in their meshes."""

    lift: Float[Tensor, " objects"]
    """In the objects' frames [m]; 0: nobody tells."""


def find_seat_heights(
    inputs: SeatInputs, config: BendConfig, observe: Observer = silent
) -> SeatHeights:
    """How much higher than in their meshes people find the seats on which they sit or lie."""
    del observe
    objects, layout = inputs.objects, inputs.layout
    tops, under = place(objects.top, layout), height_under_bodies(inputs.floor, inputs.bodies)
    found = postures(inputs.bodies, inputs.parts, under)
    lift = torch.zeros_like(layout.yaw)
    for k in (inputs.loose & objects.is_seat & objects.has_top).nonzero()[:, 0].tolist():
        rows = inputs.pairs[inputs.pairs[:, 1] == k, 0].unique()
        said: list[Tensor] = []
        for does, names in zip((found.sitting, found.lying), CARRIERS, strict=True):
            some, carried = rows[does[rows]], members(inputs.parts, *names)
            if len(some) >= FEWEST and bool(carried.any()):
                said.append(_higher(inputs.bodies.verts[some][:, carried], tops[k]))
        if said:
            lift[k] = _believed(said, config.seat) / layout.log_scale[k, 1].exp()
    return SeatHeights(lift)


def _higher(skin: Float[Tensor, "bodies points 3"], top: Float[Tensor, "region 3"]) -> Tensor:
    """How much higher than a seat these bodies are carried, in the median [m]."""
    low = skin[..., 1].quantile(LOWEST, dim=1)
    away = torch.cdist(skin.mean(1)[:, [0, 2]], top[:, [0, 2]])
    near = away.topk(min(NEAR, len(top)), largest=False).indices
    return (low - top[near, 1].median(-1).values).median()


def _believed(said: list[Tensor], shape: float) -> Tensor:
    """The mean of what is said, and of what the mesh says, by their precisions."""
    return torch.stack(said).sum() / (len(said) + (TOLD / shape) ** 2)


def offsets_of(
    lift: Float[Tensor, " objects"], straight: Objects
) -> Float[Tensor, "objects 3 3 3 3"]:
    """Moves of control points, in the objects' frames [m], that lift the seats (`geometry.cage`).

    The middle of the height moves as a whole: by 2 t (1 - t) of that at the share t of the height.

    Args:
        lift: Of each seat [m].
        straight: The furniture before anything was bent.
    """
    height = straight.size[:, 1].clamp_min(1e-9)
    share = straight.top[..., 1].median(-1).values / height
    low, high = BETWEEN
    some = (share > low) & (share < high)
    most = MOST * height
    rise = (lift / (2 * share * (1 - share)).clamp_min(1e-3)).clamp(-most, most)
    offset = torch.zeros(len(lift), 3, 3, 3, 3).to(lift)
    offset[:, :, 1, :, 1] = torch.where(some, rise, torch.zeros_like(rise))[:, None, None]
    return offset
