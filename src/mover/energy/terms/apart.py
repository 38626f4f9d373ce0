r"""Pieces of furniture do not stand in each other (not in the paper).

Evidence:  D_j, the horizontal way out of the closed mesh of object j, in its own frame [m]
Price:     L_apart = \sum_i \sum_{j \ne i} 1000 mean_u w(u) h(s_j D_j(u_i) - m)
           over even surface samples u_i of object i, as the collision term of people (robust);
           s_j: mean horizontal scale of j, m: 2 cm that two outlines may overlap;
           w: 1 where object i goes on 1 cm above and below u, else 0;
           h(d) = d^2 up to d = r, 2 r d - r^2 from there on, 0 below 0; r: 5 cm.

The way out is horizontal because furniture stands on the floor. In a table top no place is deeper
than half its thickness, so that a chair's back could stay in it at no price. A back that is far
from the edge of the top must not outweigh what is seen of both: from r on the price rises evenly. A
seat that reaches the underside of a top from below is as deep as a back, but by an error of heights
only: its upper side does not count.

The price moves; it neither turns nor stretches: two pieces should not shrink out of each other. The
robust form only, in a last descent of all objects together (`place_objects.part_objects`).
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.core.records import record
from mover.core.types import Layout, Objects
from mover.energy.terms.collision import SAMPLES
from mover.geometry.boxes import Box, corners
from mover.geometry.placement import place
from mover.geometry.rotations import rot_y
from mover.geometry.sections import Sections, outline

MARGIN = 0.02  # [m]
UPRIGHT = 0.01  # [m]
FAR = 0.05  # [m]


@record
class Solids:
    """What objects fill, and where they can stand in each other."""

    sections: Mapping[int, Sections]
    """Of each object of a pair, in its own frame."""
    upright: Bool[Tensor, "objects samples"]
    """Samples above and below which their object goes on."""
    pairs: Int[Tensor, "pairs 2"]
    """Whose samples may lie in whom; on the CPU."""


def gather_solids(
    objects: Objects, sections: Mapping[int, Sections], pairs: Int[Tensor, "pairs 2"]
) -> Solids:
    """Find the samples that count, of pairs of which one may lie in the other; on the CPU."""
    upright = torch.zeros_like(objects.samples[..., 0], dtype=torch.bool)
    for index, own in sections.items():
        above = objects.samples.new_tensor([0.0, UPRIGHT, 0.0])
        ends = torch.stack([objects.samples[index] + above, objects.samples[index] - above])
        upright[index] = (outline(own, ends) < 0.9 * own.outline.cell).all(0)
    return Solids(sections, upright, pairs)


def apart_term(layout: Layout, objects: Objects, solids: Solids) -> Float[Tensor, " objects"]:
    """Price of the samples of each object that lie inside others [1]; one place for each object."""
    layout = replace(layout, yaw=layout.yaw.detach(), log_scale=layout.log_scale.detach())
    points, pairs = place(objects.samples, layout), solids.pairs
    here = points.device.type == "cpu"
    if here:
        pairs = pairs[_meet(layout, objects, pairs)]
    total = torch.zeros_like(layout.yaw) + 0 * layout.t_world_object.sum(-1)  # of all places
    index = total.new_zeros(0, dtype=torch.long)
    for other in pairs[:, 1].unique().tolist():  # each with a volume of its own
        ones = pairs[pairs[:, 1] == other, 0]
        ones = ones if here else constant(tuple(ones.tolist()), index)
        scale = layout.log_scale[other]
        away = points[ones] - layout.t_world_object[other]
        own = away @ rot_y(layout.yaw[other]) / scale.exp()
        inside = -outline(solids.sections[other], own) * scale[::2].mean().exp()
        deep = (inside - MARGIN).relu() * solids.upright[ones]
        near = deep.clamp_max(FAR)
        total = total.index_add(0, ones, SAMPLES * (near * (2 * deep - near)).mean(-1))
    return total


def _meet(
    layout: Layout, objects: Objects, pairs: Int[Tensor, "pairs 2"]
) -> Bool[Tensor, " pairs"]:
    """Whether upright boxes about both boxes meet; else neither has a sample in the other."""
    size = objects.size * layout.log_scale.exp()
    middle = layout.t_world_object + size * size.new_tensor([0.0, 0.5, 0.0])
    ends = corners(Box(middle, size, layout.yaw)).detach()
    low, high = (end[pairs] for end in (ends.amin(-2), ends.amax(-2)))
    return ((low[:, 0] <= high[:, 1]) & (low[:, 1] <= high[:, 0])).all(-1)
