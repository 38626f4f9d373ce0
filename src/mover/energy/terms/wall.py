r"""Furniture along a wall has its back in one line with its neighbours' (not in the paper).

Price:     L_wall = \sum_i \max_w q_{iw} - \max_w q_{iw} (1 - \rho(r_{iw}))
Distance:  r_{iw} is the root mean square of how far the two rear corners of object i lie off the
           line w over the floor; its rear is the side along its width that looks away from the
           camera, so that a cabinet that is turned round stands along the same wall.
Robust:    Geman and McClure, half of it at a tenth of a metre: a piece that stands elsewhere pays
           a bounded price, the same wherever it stands.
Across:    1 - \rho is 0 where line w runs across the rear of object i.
Trust:     q_{iw} says how well other objects tell line w; 0 where none does.

A shelf whose base is hidden is held in depth by its size and by what was given alone. What stands
beside it with its base in sight tells where their wall is, `stages.line_up` from which objects.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Layout

RHO = 0.1  # [m]
ALONG = 0.7  # cosine between the outward directions of a rear and a line, below which they cross


@record
class Walls:
    """Lines over the floor along which furniture stands."""

    out: Float[Tensor, "walls 2"]
    """Unit normal (x, z), out of the room."""
    offset: Float[Tensor, " walls"]
    """Of its points along the normal [m]."""
    trust: Float[Tensor, "objects walls"]
    """How well others tell the line, in [0, 1]; 0: it says nothing about the object."""


@record
class Rears:
    """The sides of objects that look away from the camera."""

    out: Float[Tensor, "*starts objects 2"]
    """Unit normal (x, z), away from the camera."""
    ends: Float[Tensor, "*starts objects 2 2"]
    """The two corners over the floor (x, z) [m]."""


def rears_of(layout: Layout, size: Float[Tensor, "objects 3"]) -> Rears:
    """The rear side of each object; `size` is that of its mesh [m]."""
    half = size * layout.log_scale.exp() / 2
    place = layout.t_world_object[..., ::2]
    front = torch.stack([layout.yaw.sin(), layout.yaw.cos()], -1)
    away = ((front * place).sum(-1, keepdim=True) >= 0).detach().to(front) * 2 - 1
    out = front * away
    middle = place + out * half[..., 2:]
    along = torch.stack([out[..., 1], -out[..., 0]], -1) * half[..., :1]
    return Rears(out, torch.stack([middle + along, middle - along], -2))


def wall_term(
    layout: Layout, size: Float[Tensor, "objects 3"], walls: Walls
) -> Float[Tensor, "*starts objects"]:
    """Price of standing off the lines along which other furniture stands [1]."""
    rears = rears_of(layout, size)
    off = _across(rears.ends, walls.out) - walls.offset
    apart = off.square().mean(-2)
    along = _across(rears.out.detach(), walls.out) > ALONG
    near = walls.trust * along * RHO**2 / (apart + RHO**2)
    return walls.trust.amax(-1) - near.amax(-1)


def _across(
    points: Float[Tensor, "*batch 2"], out: Float[Tensor, "walls 2"]
) -> Float[Tensor, "*batch walls"]:
    """Coordinates along the normals; no matmul, whose bits change with the number of starts."""
    x, z = out.unbind(-1)
    return points[..., :1] * x + points[..., 1:] * z
