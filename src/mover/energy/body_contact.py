"""Skin that touches lies on a surface that faces it (after PROX, contact term).

Evidence:  for each skin point that touches, the nearest surface point whose normal is opposed to
           the skin's within 45 degrees, and the plane there; found again as the body moves. Where
           the distance to the furniture contradicts the plane, the surface ends before it.
Cost:      Geman-McClure of the distance from the plane; the points of one group share one weight.
           An error that a part of a person keeps over an object says no more in a hundred frames
           than in one: it is taken out, and costs once in its usual size.
Paper:     distance to the nearest vertex of the scene, normals up to their sign: a thigh inside a
           seat may be drawn through it. Here the surface must face the skin, and one may slide.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.minimize import geman_mcclure
from mover.geometry.nearest import as_float64
from mover.geometry.volume import Volume, sample


def without_kept(
    off: Float[Tensor, " items"],
    trust: Float[Tensor, " items"],
    group: Int[Tensor, " items"],
    usual: float | Float[Tensor, " groups"],
) -> tuple[Float[Tensor, " items"], Float[Tensor, " items"]]:
    """What is left of distances without the error that their group shares, and its cost.

    The shared error, of a usual size [m], is the one that costs least (ridge mean); `trust` is one
    over the variance of each distance alone [1/m²], and `group` counts from 0. The second is each
    item's share of the cost [nats].
    """
    count = int(group.max()) + 1 if len(group) else 0
    total = off.new_zeros(count).index_add(0, group, trust)
    mean = off.new_zeros(count).index_add(0, group, trust * off) / (total + usual**-2)
    part = trust / total.clamp_min(1e-9)[group]
    return off - mean[group], 0.5 * (mean / usual).square()[group] * part


FACING = -0.7071  # cosine of 135 degrees, PROX's 45 degrees with the sign
BEND = 0.15  # [m], how much a normal counts beside a place
USUAL = 0.02  # [m], usual distance of skin that touches
LAYER = 0.015  # [m], skin of a group that is no farther than this from its foremost point touches
POINTS = 3.0  # independent places of a group that touches
KEPT = 0.01  # [m], usual error that a part of a person has on one object in all frames
LEAST_CHANCE = 0.5  # above it a point of the skin touches (the paper's threshold)
REACH = 0.25  # [m], farther no surface is touched
EDGE = 0.03  # [m], by which a plane and the furniture's own distance may differ


@record
class Surface:
    """Points of the furniture."""

    points: Float[Tensor, "points 3"]  #: [m]
    normals: Float[Tensor, "points 3"]  #: outward unit normals
    piece: Int[Tensor, " points"]  #: of the furniture, from 0
    uncertainty: Float[Tensor, " pieces"]
    """Usual error of the position of each object's surface, beside `KEPT` [m]."""


@record
class Skin:
    """Skin points and the chance that they touch."""

    points: Float[Tensor, "bodies points 3"]  #: [m]
    normals: Float[Tensor, "bodies points 3"]  #: outward unit normals
    chance: Float[Tensor, "bodies points"]
    group: Int[Tensor, " points"]
    """From 0: parts of the body; points of one part share a weight and have one foremost point, so
    that a thigh that hangs does not count for the seat."""
    track: Int[Tensor, " bodies"]  #: number of each body's person, from 0
    pivot: Float[Tensor, "bodies 3"]
    """About which a body is turned by the errors of its pose: its pelvis [m]."""
    flat: Bool[Tensor, " bodies"]
    """Lying bodies: all parts have one foremost point, since backs arch over the mattress."""
    bent: float  #: usual angle by which the pose is wrong [rad]; 0: it may be corrected


@record
class Matches:
    """Which skin touches which plane."""

    body: Int[Tensor, " matches"]
    point: Int[Tensor, " matches"]  #: index of the skin point
    place: Float[Tensor, "matches 3"]  #: a point of the plane [m]
    normal: Float[Tensor, "matches 3"]
    weight: Float[Tensor, " matches"]  #: share in its group's weight; at most `POINTS` in sum
    usual: Float[Tensor, " matches"]  #: usual distance of skin that touches [m]
    kept: Int[Tensor, " matches"]
    """Which share an error that lasts: one part of one person on one object; from 0."""
    lasting: Float[Tensor, " kept"]  #: usual size of each of these errors [m]


def gather_matches(skin: Skin, surface: Surface, furniture: Volume | None = None) -> Matches:
    """The nearest surface that faces each skin point that touches."""
    body, point = (skin.chance > LEAST_CHANCE).nonzero(as_tuple=True)
    if not len(body) or not len(surface.points):
        none, empty = skin.points.new_zeros(0, 3), torch.zeros(0, dtype=torch.long)
        return Matches(empty, empty, none, none, none[:, 0], none[:, 0], empty, none[:, 0])
    places, facing = skin.points[body, point].detach(), skin.normals[body, point].detach()
    index = _nearest(places, facing, surface)
    place, normal = surface.points[index], surface.normals[index]
    off = ((places - place) * normal).sum(-1)
    groups = int(skin.group.max()) + 1
    part = body * groups + skin.group[point]
    looks = _looks(facing, skin.chance[body, point], part)
    keep = ((facing * normal).sum(-1) < FACING) & ((looks * normal).sum(-1) < FACING)
    keep = keep & ((places - place).norm(dim=-1) < REACH)
    if furniture is not None:  # a plane still is the furniture's surface where the skin is
        away = sample(furniture, places)
        keep = keep & (((away - off).abs() < EDGE) | ((away < 0) & (off < 0)))
    body, point, place, normal, part, off, index = (
        x[keep] for x in (body, point, place, normal, part, off, index)
    )
    arm = torch.linalg.cross(place - skin.pivot[body], normal).norm(dim=-1)
    rests = torch.where(skin.flat[body], body * groups, part)
    who = skin.track[body] * groups + skin.group[point]
    kept = who * len(surface.points) + surface.piece[index]
    kept, number = kept.unique(return_inverse=True)
    uncertainty = surface.uncertainty[kept % len(surface.points)]
    return Matches(
        body, point, place, normal,
        weight=_shares(skin.chance[body, point] * _foremost(off, rests), part),
        usual=(USUAL**2 + (skin.bent * arm).square()).sqrt(),
        kept=number,
        lasting=(KEPT**2 + uncertainty.square()).sqrt(),
    )  # fmt: skip


def _nearest(
    places: Float[Tensor, "asked 3"], facing: Float[Tensor, "asked 3"], surface: Surface
) -> Int[Tensor, " asked"]:
    """The surface point that is nearest in place and in the direction it faces."""
    from scipy.spatial import KDTree

    known = np.concatenate([as_float64(surface.points), BEND * as_float64(surface.normals)], 1)
    asked = np.concatenate([as_float64(places), -BEND * as_float64(facing)], 1)
    return torch.from_numpy(np.asarray(KDTree(known).query(asked)[1])).long()


def _looks(
    facing: Float[Tensor, "asked 3"], chance: Float[Tensor, " asked"], part: Int[Tensor, " asked"]
) -> Float[Tensor, "asked 3"]:
    """Where the whole part looks: a thigh lies on the seat, and not on the seat's front."""
    total = facing.new_zeros(int(part.max()) + 1, 3)
    total = total.index_add(0, part, facing * chance[:, None])
    return torch.nn.functional.normalize(total, dim=-1)[part]


def _shares(
    weight: Float[Tensor, " matches"], part: Int[Tensor, " matches"]
) -> Float[Tensor, " matches"]:
    """Weights of which each part of a body has at most `POINTS`."""
    total = weight.new_zeros(int(part.max()) + 1 if len(part) else 1)
    return POINTS * weight / total.index_add(0, part, weight)[part].clamp_min(POINTS)


def _foremost(off: Float[Tensor, " matches"], group: Int[Tensor, " matches"]) -> Tensor:
    """1 for the skin of each group that reaches farthest: what is round touches little."""
    least = off.new_full((int(group.max()) + 1 if len(group) else 1,), torch.inf)
    least = least.scatter_reduce(0, group, off, "amin")[group]
    return (off < least + LAYER).to(off)


def touch_term(
    skin: Float[Tensor, "bodies points 3"], matches: Matches, rho: float
) -> Float[Tensor, " bodies"]:
    """Cost of the distance between skin and what it touches, half of the most at `rho` [nats]."""
    moved = skin[matches.body, matches.point] - matches.place
    off = (moved * matches.normal).sum(-1)
    robust = (rho**2 / (off.square() + rho**2)).square()
    off, lasting = without_kept(
        off, robust * matches.weight / matches.usual.square(), matches.kept, matches.lasting
    )
    cost = 0.5 * (rho / matches.usual).square() * matches.weight * geman_mcclure(off, rho)
    cost = cost + lasting
    return skin.new_zeros(len(skin)).index_add(0, matches.body, cost)
