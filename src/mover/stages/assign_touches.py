"""Find the object that each touching body part touches (Sec. 3.1, "Contact constraint").

By the overlap of its projection with the objects' masks and by the distance in 3D: `touch_groups`
has the rules of the three presets.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..bodies.parts import PARTS
from ..bodies.touch import headings, postures
from ..geometry.mesh import vertex_normals
from ..minimize import Observer, silent
from ..records import record
from ..terms.contact import Touches
from .thin_points import thin
from .touch_groups import AssignConfig, ContactRows, TouchInputs, contact_rows

LEVEL = 0.7071  # cosine of 45 degrees, the released code's split of the normals


@record
class Contacts:
    """Who touches what."""

    touches: Touches | None
    """Contact points of each object; None: nothing is touched."""
    seated_on: Bool[Tensor, " bodies"]
    """Bodies whose seat or back touches an object."""
    touched_in: tuple[int, ...]
    """Number of bodies that touch each object."""
    pairs: Int[Tensor, "pairs 3"]
    """Who touches what: body, object, and part as in `Touches.points`."""


def assign_touches(
    inputs: TouchInputs, config: AssignConfig, observe: Observer = silent
) -> Contacts:
    """Give each touching part of each body to the object that it touches."""
    del observe
    found = [c for c in contact_rows(inputs, config) if len(c.body)]
    seated = torch.zeros(len(inputs.bodies.frame), dtype=torch.bool)
    counts = [0] * len(inputs.objects.ids)
    if not found:
        return Contacts(None, seated, tuple(counts), torch.zeros(0, 3, dtype=torch.long))
    names = ("body", "vert", "object_of", "hand")
    rows = ContactRows(*(torch.cat([getattr(c, n) for c in found]) for n in names))
    seated[rows.body[~rows.hand]] = True
    part = _parts(rows, inputs, config)
    touches = _pack(rows, part, inputs, config)
    for i, bodies in zip(touches.object_of.tolist(), touches.bodies.tolist(), strict=True):
        counts[i] = int(bodies)
    pairs = torch.stack([rows.body, rows.object_of, part], -1).unique(dim=0)
    return Contacts(touches, seated, tuple(counts), pairs)


def _parts(rows: ContactRows, inputs: TouchInputs, config: AssignConfig) -> Int[Tensor, " rows"]:
    """The part that each row touches: top, back, and the same for hands."""
    normals = vertex_normals(inputs.bodies.verts, inputs.bodies.faces)[rows.body, rows.vert]
    level = normals[:, 1].abs() >= LEVEL
    if config.split == "parts":
        level = level | (inputs.parts.part_of[rows.vert] != PARTS.index("back"))
    return (~level).long() + 2 * rows.hand.long()


def _pack(
    rows: ContactRows, part: Int[Tensor, " rows"], inputs: TouchInputs, config: AssignConfig
) -> Touches:
    points = inputs.bodies.verts[rows.body, rows.vert]
    touched = rows.object_of.unique()
    packed, weight = thin(
        points,
        torch.searchsorted(touched, rows.object_of) * 4 + part,
        4 * len(touched),
        (config.cell, config.most),
    )
    back = inputs.objects.has_back[touched].float()
    usable = torch.stack([torch.ones_like(back), back, torch.ones_like(back), back], -1)
    weight = weight.unflatten(0, (len(touched), 4)) * usable.unsqueeze(-1)
    bodies = [len(rows.body[rows.object_of == o].unique()) for o in touched.tolist()]
    return Touches(
        touched, packed.unflatten(0, (len(touched), 4)), weight,
        torch.tensor(bodies, dtype=points.dtype), _headings(rows, touched, inputs),
    )  # fmt: skip


def _headings(rows: ContactRows, touched: Int[Tensor, " touched"], inputs: TouchInputs) -> Tensor:
    """Mean horizontal direction of those who sit on each touched object; zero for none.

    Only of objects with a back: one sits on the side of a bed, and round a stool.
    """
    facing = headings(inputs.bodies, inputs.parts)[:, [0, 2]]
    sits = postures(inputs.bodies, inputs.parts).sitting
    means: list[Tensor] = []
    for o in touched.tolist():
        seated = rows.body[(rows.object_of == o) & ~rows.hand].unique()
        mean = facing[seated[sits[seated]]].sum(0)
        told = bool(inputs.objects.has_back[o]) and float(mean.norm()) > 0.1
        means.append(mean / mean.norm() if told else 0 * mean)
    return torch.stack(means)
