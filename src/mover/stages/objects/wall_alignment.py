"""Find the lines along which furniture stands, from where it was placed, and place it again.

Each object that usually stands with its back to a wall proposes the line of its rear; the rears of
others that lie near it and along it belong to the line, which runs through the middle of them all.
Objects whose base is seen count in full, all others little: their own distance is what is asked.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Int
from torch import Tensor

from mover.core.types import Layout, Objects
from mover.energy.image_terms import SEEN
from mover.energy.prior_terms import ALONG, Walls, rears_of
from mover.furniture.library import WALL_PIECES
from mover.geometry.placement import GROUND
from mover.geometry.rotations import wrap
from mover.stages.objects.place_inputs import Placed, PlaceInputs, with_walls
from mover.stages.objects.starts import best_few, piles_of

NEAR = 0.3  # [m], root mean square distance of a rear from the line that it belongs to
UNSEEN = 0.2  # how much an object whose base is not seen counts against one whose base is
TURN = math.pi / 4  # rears that are turned farther than this do not belong to a line
STRETCH = (0.7, 1.4)  # of its distance, within which an object is moved to a line
BOTTOM = 3  # number of the side of a box on which the object stands
ROUNDS = 2  # the lines run where the objects were found at first, then where these lines put them
STILL = 0.01  # [m], lines that moved by less are not used once more
KEPT = 3  # candidates of the search without lines from which an object descends again


def line_up(
    found: Placed, inputs: PlaceInputs, lower: Callable[[PlaceInputs, Layout], Placed]
) -> Placed:
    """Place the objects along walls again, with the lines of others.

    Returns:
        Objects that belong to no line are as they were found.
    """
    lined = found
    for _ in range(ROUNDS):
        walls = find_walls(lined.layout, inputs.objects, inputs.image.sides)
        if walls is None or (
            lined.walls is not None
            and torch.allclose(walls.offset, lined.walls.offset, rtol=0.0, atol=STILL)
        ):
            break
        starts = starts_at(lined.layout, inputs.objects, walls)
        few = best_few(found.candidates, found.energy, KEPT)
        pile = piles_of(inputs.objects.supports)  # one start is enough for those of no line
        moves = torch.isin(pile, pile[walls.trust.amax(-1) > 0])
        start = Layout.where(moves, Layout.cat(starts, few), lined.layout[None])
        more = lower(with_walls(inputs, walls), start)
        on_line = walls.trust.amax(-1) > 0
        count = min(len(more.energy), len(found.energy))  # as many candidates of both
        lined = Placed(
            Layout.where(on_line, more.layout, found.layout),
            Layout.where(on_line, more.candidates[:count], found.candidates[:count]),
            torch.where(on_line, more.energy[:count], found.energy[:count]),
            found.trace,
            walls,
        )
    return lined


def find_walls(layout: Layout, objects: Objects, sides: Int[Tensor, "objects 4"]) -> Walls | None:
    """The lines that the rears of at least one object share with another.

    Returns:
        None where fewer than two objects usually stand along a wall.
    """
    usual = torch.tensor([c in WALL_PIECES for c in objects.categories], dtype=torch.bool)
    able = usual.to(objects.supports.device) & (objects.supports == GROUND)
    if int(able.sum()) < 2:
        return None
    rears = rears_of(layout, objects.size)
    middle = rears.ends.mean(-2)
    sure = torch.where(sides[:, BOTTOM].to(able.device) == SEEN, 1.0, UNSEEN).to(middle) * able
    lines = able.nonzero()[:, 0]
    out, at = rears.out[lines], middle[lines]
    off = torch.einsum("oed,ld->loe", rears.ends, out) - (at * out).sum(-1)[:, None, None]
    near = (off.square().mean(-1).sqrt() < NEAR) & (out @ rears.out.mT > ALONG) & able
    weight = near * sure
    out = torch.nn.functional.normalize(weight @ rears.out, dim=-1)
    offset = (weight * (out @ middle.mT)).sum(-1) / weight.sum(-1)
    others = weight[:, None] * ~torch.eye(weight.shape[1], dtype=torch.bool).to(weight.device)
    return Walls(out, offset, others.amax(-1).mT * able[:, None])


def starts_at(layout: Layout, objects: Objects, walls: Walls) -> Layout:
    """The layout, and for each line one in which all objects that may stand along it do so.

    They turn with the line and go along their rays, as large in the image as before.
    """
    moved = [_moved(layout, objects, walls, number) for number in range(len(walls.offset))]
    return Layout.cat(*(one[None] for one in (layout, *moved)))


def _moved(layout: Layout, objects: Objects, walls: Walls, number: int) -> Layout:
    line = walls.out[number]
    out = rears_of(layout, objects.size).out
    turn = wrap(torch.atan2(line[0], line[1]) - torch.atan2(out[:, 0], out[:, 1]))
    depth = objects.size[:, 2] * layout.log_scale[:, 2].exp()
    ahead = layout.t_world_object[:, ::2] @ line
    share = walls.offset[number] / (ahead + depth / 2).clamp_min(1e-6)
    low, high = STRETCH
    goes = (walls.trust[:, number] > 0) & (turn.abs() < TURN) & (share > low) & (share < high)
    goes = goes & (ahead > 0)  # else its other side would look away from the camera
    share = torch.where(goes, share, 1.0)
    stretch = torch.stack([share, torch.ones_like(share), share], -1)
    return Layout(
        layout.t_world_object * stretch,
        torch.where(goes, wrap(layout.yaw + turn), layout.yaw),
        layout.log_scale + share.log().unsqueeze(-1),
    )
