r"""Skin that touches lies on a surface that faces it (after PROX, contact term).

Evidence:  for each skin point that touches, the nearest surface point whose normal is opposed to
           the skin's within 45 degrees, and the plane there; found anew as the body moves. Where
           the distance to the furniture contradicts the plane, the surface ends before it.
Price:     Geman-McClure of the distance from the plane; the points of one group share one weight.
Paper:     distance to the nearest vertex of the scene, normals up to their sign: a thigh inside a
           seat may be drawn through it. Here the surface must face the skin, and one may slide.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..geometry.nearest import as_float64
from ..geometry.volume import Volume, sample
from ..minimize import geman_mcclure
from ..records import record

FACING = -0.7071  # cosine of 135 degrees, PROX's 45 degrees with the sign
BEND = 0.15  # [m], how much a normal counts beside a place
USUAL = 0.02  # [m], usual distance of skin that touches
LAYER = 0.015  # [m], skin of a group that is no farther than this from its foremost point touches
POINTS = 3.0  # independent places of a group that touches
EDGE = 0.03  # [m], by which a plane and the furniture's own distance may differ


@record
class Surface:
    """Points of the furniture."""

    points: Float[Tensor, "points 3"]
    """[m]."""
    normals: Float[Tensor, "points 3"]
    """Outward unit normals."""


@record
class Skin:
    """Skin points and the chance that they touch."""

    points: Float[Tensor, "bodies points 3"]
    """[m]."""
    normals: Float[Tensor, "bodies points 3"]
    """Outward unit normals."""
    chance: Float[Tensor, "bodies points"]
    group: Int[Tensor, " points"]
    """From 0: parts of the body; points of one part on level, or on steep, surfaces share a weight
    and have one foremost point, so that a thigh that hangs does not speak for the seat."""


@record
class Matches:
    """Which skin touches which plane."""

    body: Int[Tensor, " matches"]
    point: Int[Tensor, " matches"]
    """Index of the skin point."""
    place: Float[Tensor, "matches 3"]
    """A point of the plane [m]."""
    normal: Float[Tensor, "matches 3"]
    weight: Float[Tensor, " matches"]
    """Share in its group's weight; at most `POINTS` in sum."""


@dataclass(frozen=True)
class MatchConfig:
    """Which skin is believed to touch."""

    least: float = 0.5
    """Chance above which a point of the skin touches (the paper's threshold)."""
    reach: float = 0.25
    """Farther no surface is touched [m]."""


def gather_matches(
    skin: Skin, surface: Surface, config: MatchConfig, furniture: Volume | None = None
) -> Matches:
    """The nearest surface that faces each skin point that touches."""
    from scipy.spatial import KDTree

    body, point = (skin.chance > config.least).nonzero(as_tuple=True)
    if not len(body) or not len(surface.points):
        return _nothing(skin)
    places, facing = skin.points[body, point].detach(), skin.normals[body, point].detach()
    known = np.concatenate([as_float64(surface.points), BEND * as_float64(surface.normals)], 1)
    asked = np.concatenate([as_float64(places), -BEND * as_float64(facing)], 1)
    index = torch.from_numpy(np.asarray(KDTree(known).query(asked)[1])).long()
    place, normal = surface.points[index], surface.normals[index]
    opposed = (facing * normal).sum(-1) < FACING
    keep = opposed & ((places - place).norm(dim=-1) < config.reach)
    if furniture is not None:
        keep = keep & _on_surface(sample(furniture, places), ((places - place) * normal).sum(-1))
    body, point, place, normal = body[keep], point[keep], place[keep], normal[keep]
    off = ((skin.points[body, point].detach() - place) * normal).sum(-1)
    level = (normal[:, 1].abs() > -FACING).long()
    group = 2 * (body * (int(skin.group.max()) + 1) + skin.group[point]) + level
    weight = skin.chance[body, point] * _foremost(off, group)
    total = weight.new_zeros(int(group.max()) + 1 if len(group) else 1)
    total = total.index_add(0, group, weight)[group]
    return Matches(body, point, place, normal, POINTS * weight / total.clamp_min(POINTS))


def _on_surface(
    distance: Float[Tensor, " matches"], off: Float[Tensor, " matches"]
) -> Bool[Tensor, " matches"]:
    """Whether a plane still is the surface of the furniture where the skin is.

    Args:
        distance: Of the skin from the furniture, negative inside [m].
        off: Of the skin from the plane [m].
    """
    return ((distance - off).abs() < EDGE) | ((distance < 0) & (off < 0))


def _foremost(off: Float[Tensor, " matches"], group: Int[Tensor, " matches"]) -> Tensor:
    """1 for the skin of each group that reaches farthest: what is round touches little.

    Args:
        off: Distance from the plane, negative inside [m].
        group: Body, group and steepness of each match.
    """
    least = off.new_full((int(group.max()) + 1 if len(group) else 1,), torch.inf)
    least = least.scatter_reduce(0, group, off, "amin")[group]
    return (off < least + LAYER).to(off)


def touch_term(
    skin: Float[Tensor, "bodies points 3"], matches: Matches, rho: float
) -> Float[Tensor, " bodies"]:
    """Price of the distance between skin and what it touches [nats].

    Args:
        skin: The skin points [m].
        matches: What they touch.
        rho: Distance at which half of the most is paid [m].
    """
    moved = skin[matches.body, matches.point] - matches.place
    off = geman_mcclure((moved * matches.normal).sum(-1), rho)
    price = 0.5 * (rho / USUAL) ** 2 * matches.weight * off
    return skin.new_zeros(len(skin)).index_add(0, matches.body, price)


def _nothing(skin: Skin) -> Matches:
    empty = torch.zeros(0, dtype=torch.long)
    none = skin.points.new_zeros(0, 3)
    return Matches(empty, empty, none, none, skin.points.new_zeros(0))
