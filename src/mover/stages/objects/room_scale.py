"""How large the whole room is: what people's size leaves open, furniture and seats constrain.

Not in the paper, whose people have their own size. People of unknown height make floor, places and
sizes too large at once, which no image shows. Three things do: how far away and how large each
object was given, standard dimensions of furniture, and how high people sit, since seats are made
for legs.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.parts import BodyParts, members
from mover.bodies.posture import at, landmarks, postures
from mover.core.records import record
from mover.core.types import Bodies, Layout
from mover.energy.prior_terms import AWAY, COMMON, SIZE, Given

TOOL = 0.04  # ... and all given sizes of a room: shapes of one tool fill their boxes similarly
FITTED = 0.06  # error of a logarithm of a distance or size that the image alone finds
TRIED = 121  # scales
SEAT = 0.44  # [m], of a usual seat over the floor
SEATS = 0.06  # standard deviation of its logarithm: chairs .43-.47, sofas .40-.45, offices .42-.50
POSES = 0.04  # the same of how high people seem to sit: all their poses err together
CARRIED = ("seat", "left_thigh", "right_thigh")  # of a seated person
LOWEST = 0.1  # share of a sitter's points below the top of the seat
SAME = 0.3  # [m] between two who sit on one seat
FEWEST = 3  # bodies that give the height of a seat


@record
class ScaleKnown:
    """What constrains the scale of a room beside its furniture."""

    spread: float
    """Standard deviation of the logarithm of the people's size; 0: it is known."""
    shared: float = 0.0
    """The same of all that was given, together (`Scene.size_spread`)."""
    seats: tuple[float, float] | None = None
    """Logarithm of how much too high people sit, and its standard deviation."""


def common_scale(layout: Layout, given: Given, known: ScaleKnown) -> tuple[float, float]:
    """Logarithm of how much too large the whole room is, and its standard deviation.

    Args:
        layout: Where the objects were placed under the people's scale.
        given: What was expected of them.
        known: What else is known.
    """
    spread, shared = known.spread, known.shared
    if spread <= 0:
        return 0.0, 0.0
    tried = torch.linspace(-3 * spread, 3 * spread, TRIED, dtype=torch.float64)
    if shared:
        wide = torch.linspace(-3, 3, TRIED, dtype=torch.float64) * (spread + shared)
        near = -0.5 * ((tried[:, None] - wide) / shared).square()
        total = -torch.logsumexp(near - _cost_of_scales(layout, given, wide), 1)
    else:
        total = _cost_of_scales(layout, given, tried)
    total = total + 0.5 * (tried / spread).square()
    if known.seats is not None:
        total = total + 0.5 * ((tried - known.seats[0]) / known.seats[1]).square()
    weight = (total.min() - total).exp()
    mean = float((weight * tried).sum() / weight.sum())
    return mean, float((weight * (tried - mean).square()).sum() / weight.sum()) ** 0.5


def _cost_of_scales(
    layout: Layout, given: Given, tried: Float[Tensor, " scales"]
) -> Float[Tensor, " scales"]:
    """What places and sizes cost in rooms too large by the exponential of each [nats]."""
    away = (layout.t_world_object.norm(dim=-1) / given.distance).log().double()
    near = away[:, None] - tried
    places = 2 * (1 + near.square() / (3 * (AWAY**2 + FITTED**2))).log()
    off = torch.linspace(-3, 3, TRIED, dtype=torch.float64) * TOOL
    sizes = _cost_of_sizes(layout, given, tried, off) + 0.5 * (off / TOOL).square()
    return places.sum(0) - torch.logsumexp(-sizes, 1)


def _cost_of_sizes(
    layout: Layout, given: Given, tried: Float[Tensor, " scales"], off: Float[Tensor, " offs"]
) -> Float[Tensor, "scales offs"]:
    """The same of sizes alone, where all were given too small by the exponential of each `off`."""
    one, each = torch.ones(3).to(off), torch.eye(3).to(off)
    own = torch.linalg.inv(SIZE**2 * each + COMMON**2)
    sharp = torch.diag_embed(given.precision.to(off))
    said = off[:, None] * one  # offs, 3
    usual = given.standard.to(off)
    precision = own + sharp
    mean = torch.linalg.solve(
        precision[:, None], ((said @ own)[None] + (usual[:, None] @ sharp)).unsqueeze(-1)
    ).squeeze(-1)  # objects, offs, 3
    apart = usual[:, None] - said
    parted = sharp @ torch.linalg.inv(precision) @ own  # between both: parallel sum
    disagree = torch.einsum("noi,nij,noj->o", apart, parted, apart)
    fitted = torch.linalg.inv(torch.linalg.inv(precision) + FITTED**2 * each)
    rest = layout.log_scale.to(off)[:, None, None] - mean[:, None] - tried[:, None, None]
    return 0.5 * (torch.einsum("nsoi,nij,nsoj->so", rest, fitted, rest) + disagree)


def seat_height_estimate(
    bodies: Bodies, parts: BodyParts, floor: float
) -> tuple[float, float] | None:
    """Logarithm of the ratio of observed to usual seat height, and its standard deviation.

    Args:
        bodies: In the world, in the people's scale.
        parts: Of their mesh.
        floor: Its height below them [m].

    Returns:
        None where no person is seated.
    """
    carried = members(parts, *CARRIED)
    sits = postures(bodies, parts, floor).sitting
    if not bool(sits.any()) or not bool(carried.any()):
        return None
    height = bodies.verts[sits][:, carried, 1].quantile(LOWEST, dim=1) - floor
    hips = at(landmarks(bodies, parts), "hips")[sits][:, [0, 2]]
    heights = [height[rows].median() for rows in _places(hips) if int(rows.sum()) >= FEWEST]
    heights = [h for h in heights if float(h) > 0]
    if not heights:
        return None
    spread = (SEATS**2 / len(heights) + POSES**2) ** 0.5
    return float((torch.stack(heights) / SEAT).log().mean()), spread


def _places(points: Float[Tensor, "rows 2"]) -> list[Bool[Tensor, " rows"]]:
    """People seated on one seat: all that are near to the first that is left."""
    left, found = torch.ones(len(points), dtype=torch.bool), list[Bool[Tensor, " rows"]]()
    while bool(left.any()):
        first = points[left.nonzero()[0, 0]]
        near = left & ((points - first).norm(dim=-1) < SAME).cpu()
        found.append(near)
        left = left & ~near
    return found
