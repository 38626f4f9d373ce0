"""Who touches an object, when, and how near the touching surfaces are at the result."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..explanation_records import Touching
from ..geometry.placement import place
from ..terms.contact import Touches
from ..types import Bodies, Layout, Objects

PAUSE = 10  # frames (of those that are common between two bodies) that end a touch


def touching_of(
    objects: Objects,
    layout: Layout,
    touches: Touches | None,
    pairs: Int[Tensor, "pairs 3"],
    bodies: Bodies,
) -> tuple[tuple[Touching, ...], ...]:
    """For each object and part the people who touch it, those who do it longest first.

    Args:
        objects: The furniture.
        layout: Where it stands.
        touches: The contact points of all people together.
        pairs: Body, object and part of every touch.
        bodies: The people whose rows `pairs` counts.
    """
    if touches is None:
        return tuple(() for _ in objects.ids)
    gap = _gaps(objects, layout, touches)
    row = {o: k for k, o in enumerate(touches.object_of.tolist())}
    found: list[list[Touching]] = [[] for _ in objects.ids]
    for i, part, person in _kinds(pairs, bodies):
        mine = (pairs[:, 1] == i) & (pairs[:, 2] == part)
        rows = pairs[mine & (bodies.person[pairs[:, 0]] == person), 0]
        if not bool(_used(touches)[row[i], part]):
            continue
        name = "back" if part % 2 else ("seat" if bool(objects.is_seat[i]) else "top")
        frames = bodies.frame[rows].sort().values
        found[i].append(
            Touching(
                name, part >= 2, person, _runs(frames, bodies), len(rows), float(gap[row[i], part])
            )
        )
    return tuple(tuple(sorted(f, key=lambda t: -t.bodies)) for f in found)


def _kinds(pairs: Int[Tensor, "pairs 3"], bodies: Bodies) -> list[tuple[int, int, int]]:
    """Every object, part and person that occur together."""
    keys = torch.stack([pairs[:, 1], pairs[:, 2], bodies.person[pairs[:, 0]]], -1).unique(dim=0)
    return [(int(i), int(part), int(person)) for i, part, person in keys.tolist()]


def _used(touches: Touches) -> Bool[Tensor, "touched 4"]:
    return (touches.weight > 0).any(-1)


def _gaps(objects: Objects, layout: Layout, touches: Touches) -> Float[Tensor, "touched 4"]:
    """Mean distance of the contact points from the part that they touch [m]."""
    top, back = (place(r, layout)[touches.object_of] for r in (objects.top, objects.back))
    parts = torch.stack([top, back, top, back], 1)
    away = torch.cdist(touches.points, parts).amin(-1)
    return (away * touches.weight).sum(-1) / touches.weight.sum(-1).clamp_min(1e-9)


def _runs(frames: Int[Tensor, " rows"], bodies: Bodies) -> tuple[tuple[int, int], ...]:
    """First and last frame of every time, longest first."""
    known = bodies.frame.unique()
    step = int(known.diff().median()) if len(known) > 1 else 1
    cut = (frames.diff() > PAUSE * max(step, 1)).nonzero()[:, 0] + 1
    times = [(int(t[0]), int(t[-1])) for t in torch.tensor_split(frames, cut)]
    return tuple(sorted(times, key=lambda t: (t[0] - t[1], t[0])))
