"""Other places that the evidence allows nearly as well as the chosen one."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from ..explanation_records import Alternative
from ..geometry.rotations import wrap
from ..minimize import Energy
from ..types import Layout
from .explain_curvature import unvector, vector
from .explain_spread import heat_of
from .place_objects import Placed
from .starts import MOVED, TURNED

HIGHEST = 6.0  # rise from which on an alternative is not told


def others_of(
    placed: Placed,
    reference: Float[Tensor, " objects"],
    tie: float,
    energy: Callable[[Layout], Energy],
) -> tuple[tuple[Alternative, ...], ...]:
    """For each object its candidates that really differ from the result and from each other.

    The candidates of the descents, and the result turned round: tables and cabinets look alike
    from behind. They rank as in `starts.choose`.
    """
    base = vector(placed.layout)
    behind = turned_round(base)
    with torch.no_grad():
        whole = energy(unvector(torch.stack([base, behind]))).per_item
    rows = torch.cat([base[None], vector(placed.candidates), behind[None]])
    value = torch.cat([whole[:1], placed.energy.to(whole), whole[1:]]).double()
    turn = 1 - (rows[..., 3] - reference).cos().double()
    rank = (value + 0.01) * (1 + tie * turn / 2)
    rise = (rank - rank[0]) / heat_of(value[0])
    return tuple(_apart(rows[:, i].double(), rise[:, i]) for i in range(rows.shape[1]))


def _apart(
    rows: Float[Tensor, "places 7"], rise: Float[Tensor, " places"]
) -> tuple[Alternative, ...]:
    """Places other than the first one, lowest first, that differ from all before."""
    kept: list[int] = [0]
    for k in (1 + rise[1:].argsort(stable=True)).tolist():
        if float(rise[k]) < HIGHEST and all(_differ(rows[k], rows[j]) for j in kept):
            kept.append(k)
    return tuple(Alternative(float(rise[k]), rows[k]) for k in kept[1:])


def turned_round(rows: Float[Tensor, "*any 7"]) -> Float[Tensor, "*any 7"]:
    """Objects whose front is where their back was."""
    yaw = wrap(rows[..., 3:4] + torch.pi)
    return torch.cat([rows[..., :3], yaw, rows[..., 4:]], -1)


def _differ(a: Float[Tensor, "7"], b: Float[Tensor, "7"]) -> bool:
    return float(wrap(a[3] - b[3]).abs()) >= TURNED or float((a[:3] - b[:3]).norm()) >= MOVED
