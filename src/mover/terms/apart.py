r"""Pieces of furniture do not stand in each other (not in the paper).

Evidence:  V_j, the signed distance to the closed mesh of object j in its own frame [m]
Price:     L_apart = \sum_i \sum_{j \ne i} 1000 mean_u \max(0, -s_j V_j(u_i) - m)^2
           over even surface samples u_i of object i, as the collision term of people (robust);
           s_j: mean scale of j, m: 2 cm that two meshes may overlap.

The robust form only, in a last descent of all objects together (`stages.part_objects`).
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..constants import constant
from ..geometry.placement import place
from ..geometry.rotations import rot_y
from ..geometry.volume import Volume, sample
from ..types import Layout, Objects
from .collision import ROBUST

MARGIN = 0.02  # [m]


def apart_term(
    layout: Layout,
    objects: Objects,
    solids: Mapping[int, Volume],
    pairs: Int[Tensor, "pairs 2"],
) -> Float[Tensor, " objects"]:
    """Price of the samples of each object that lie inside others [1].

    Args:
        layout: One place for each object.
        objects: Their samples.
        solids: Signed distance to each object of a pair in its own frame [m].
        pairs: Whose samples may lie in whom; on the CPU.
    """
    points = place(objects.samples, layout)
    total = torch.zeros_like(layout.yaw)
    index = total.new_zeros(0, dtype=torch.long)
    for one, other in pairs.tolist():
        scale = layout.log_scale[other].exp()
        away = points[one] - layout.t_world_object[other]
        own = away @ rot_y(layout.yaw[other]) / scale
        deep = (-sample(solids[other], own) * layout.log_scale[other].mean().exp() - MARGIN).relu()
        price = ROBUST * deep.square().mean()
        total = total.index_add(0, constant((one,), index), price[None])
    return total
