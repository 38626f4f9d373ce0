"""Which body, in which frame, came nearest to an object."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..explanation_records import Passing
from ..geometry.mesh import signed_volume
from ..geometry.placement import place
from ..geometry.volume import SHELL, Volume, sample
from ..types import Bodies, Layout, Mesh, Objects

SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))


def passing_by(
    objects: Objects, layout: Layout, volume: Volume, bodies: Bodies
) -> tuple[Passing, ...]:
    """The nearest body of each object, by the sample of its surface that is nearest to any.

    The distance is that of the volume; the body is the one whose vertices agree with it best.
    """
    reach = SHELL * volume.cell
    samples = place(objects.samples, layout)
    away = sample(volume, samples)
    distance, index = away.min(-1)
    rows = torch.arange(len(index))
    points, local = samples[rows, index], objects.samples[rows, index]
    owner = _owners(points, distance, bodies, reach)
    found: list[Passing] = []
    for i, body in enumerate(owner):
        if body < 0 or float(distance[i]) >= reach:
            found.append(Passing(reach, -1, -1, ""))
            continue
        frame, person = int(bodies.frame[body]), int(bodies.person[body])
        side = side_of(local[i], objects.size[i])
        found.append(Passing(float(distance[i]), frame, person, side))
    return tuple(found)


def side_of(point: Float[Tensor, "3"], size: Float[Tensor, "3"]) -> str:
    """The side of an object's box that a point of its surface is nearest to."""
    middle = torch.stack([torch.zeros_like(size[1]), size[1] / 2, torch.zeros_like(size[1])])
    share = (point - middle) / (size / 2).clamp_min(1e-6)
    axis = int(share.abs().argmax())
    return SIDES[axis][int(share[axis] > 0)]


def _owners(
    points: Float[Tensor, "objects 3"],
    distance: Float[Tensor, " objects"],
    bodies: Bodies,
    reach: float,
) -> list[int]:
    """The body of each point; -1 where none is near."""
    best = [float("inf")] * len(points)
    owner = [-1] * len(points)
    near = distance < reach
    if len(bodies.verts) and signed_volume(Mesh(bodies.verts[0], bodies.faces)) < 0:
        bodies = replace(bodies, faces=bodies.faces.flip(-1))
    slack = distance.abs() + reach
    for row, verts in enumerate(bodies.verts):  # one at a time: memory stays that of one
        low, high = verts.amin(0), verts.amax(0)
        beside = ((low - points).relu() + (points - high).relu()).norm(dim=-1)
        asked = (near & (beside <= slack)).nonzero()[:, 0]
        if not len(asked):
            continue
        told = _signed(points[asked], verts, bodies)
        for i, value in zip(asked.tolist(), told.tolist(), strict=True):
            if value < best[i]:
                best[i], owner[i] = value, row
    return owner


def _signed(
    points: Float[Tensor, "asked 3"], verts: Float[Tensor, "verts 3"], bodies: Bodies
) -> Float[Tensor, " asked"]:
    """Distance from the nearest vertex [m], negative behind its normal."""
    away, index = torch.cdist(points, verts).min(-1)
    inside = [
        bool((p - verts[i]) @ _normal(verts, bodies.faces, i) < 0)
        for p, i in zip(points, index.tolist(), strict=True)
    ]
    return torch.where(torch.tensor(inside), -away, away)


def _normal(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], index: int
) -> Float[Tensor, "3"]:
    """Direction of the surface at one vertex."""
    around = faces[(faces == index).any(-1)]
    a, b, c = verts[around].unbind(-2)
    return torch.linalg.cross(b - a, c - a).sum(0)
