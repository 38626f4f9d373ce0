"""Separate objects that stand in each other, by a last descent of all of them together.

Each object alone is placed by what is seen of it. A nightstand behind a bed may then stand partly
in the bed at no cost; together, both go where neither image nor people object.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Energy, Observer, silent
from mover.core.types import Layout, Objects
from mover.energy.config import Adam
from mover.energy.minimize import minimize
from mover.energy.prior_terms import Sections, apart_term, gather_solids, sections_of
from mover.geometry.boxes import Box, corners

NEAR = 0.1  # [m], boxes whose circles are no nearer are not looked at
METHOD = Adam(200, 0.01, 0.001, beta2=0.98)  # 80 cm at most


def separate_objects(
    energy: Callable[[Layout], Energy],
    objects: Objects,
    layout: Layout,
    weight: float,
    observe: Observer = silent,
) -> Layout:
    """Minimise the energy of all objects and the volume that they share.

    Returns:
        The same layout if none stands in another; in any case the same position of each object that
        has no part in it.
    """
    if weight == 0:
        return layout
    shared = sharing(objects, layout)
    with torch.no_grad():
        if not bool((shared(layout) > 0).any()):
            return layout

    def together(free: Layout) -> Energy:
        return Energy({"alone": energy(free[None]).per_item[0], "apart": weight * shared(free)})

    found = minimize(together, layout, METHOD, observe, "place_objects").at
    return Layout.where(_pushed(shared, layout) | _pushed(shared, found), found, layout)


def _pushed(shared: Callable[[Layout], Tensor], layout: Layout) -> Bool[Tensor, " objects"]:
    """The objects that stand in another, and those in which another stands."""
    t = layout.t_world_object.detach().clone().requires_grad_()
    with torch.enable_grad():
        (slope,) = torch.autograd.grad(shared(replace(layout, t_world_object=t)).sum(), t)
    return (slope != 0).any(-1)


def sharing(objects: Objects, layout: Layout) -> Callable[[Layout], Float[Tensor, " objects"]]:
    """Share of each object that stands in others, near a layout (`prior_terms.apart_term`) [1]."""
    pairs = _pairs(objects, layout)
    sections = {i: own_sections(objects, i) for i in pairs.unique().tolist()}
    solids = gather_solids(objects, sections, pairs)
    return lambda at: apart_term(at, objects, solids)


def _pairs(objects: Objects, layout: Layout) -> Int[Tensor, "pairs 2"]:
    """Ordered pairs whose boxes are near each other, none carrying the other; on the CPU."""
    size = objects.size * layout.log_scale.exp()
    ends = corners(Box(layout.t_world_object, size, layout.yaw))[..., [0, 2]]
    middle = ends.mean(-2)
    reach = (ends - middle.unsqueeze(-2)).norm(dim=-1).amax(-1)
    gap = (middle[:, None] - middle[None]).norm(dim=-1) - reach[:, None] - reach[None]
    related = torch.eye(len(objects.ids), dtype=torch.bool)
    for index, carrier in enumerate(objects.supports.tolist()):
        if carrier >= 0:
            related[index, carrier] = related[carrier, index] = True
    return (gap < NEAR).cpu().logical_and(~related).nonzero()


def own_sections(objects: Objects, index: int) -> Sections:
    """What an object fills, in its own frame."""
    faces = objects.faces[index]
    faces = faces[faces[:, 0] != faces[:, 1]]
    return sections_of(objects.verts[index][objects.real_verts[index]].float(), faces)
