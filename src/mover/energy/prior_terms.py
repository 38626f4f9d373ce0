r"""Terms of Eq. 1 that are known of objects before they are seen, and of objects together.

    Sizes     L_scale    = \sum_i \| s_i / s_i^{init} - 1 \|_2
    Distance  L_distance = \sum_i \rho(\log \| t_i \| / \| t_i^{init} \|)
    Given     L_given    = \sum_i d_i (P_i^{place} + P_i^{size})
                              + \min(d_i, 1) (P_i^{yaw} + P_i^{axis})
    Walls     L_wall     = \sum_i \max_w q_{iw} - \max_w q_{iw} (1 - \rho(r_{iw}))
    Apart     L_apart    = \sum_i \sum_{j \ne i} 1000 mean_u w(u) h(s_j D_j(u_i) - m)

The first is of the paper (supplement, "Loss Terms"); the others are not (`robust` only).

How deep a place lies in a solid is the horizontal way out of it: furniture stands on the floor, and
what stands in a table top cannot leave through its thickness. So the depth is measured within the
horizontal section of the solid at the height of the place. 20 cm from the edge of a table top it is
20 cm, however thin the top; below the top it is nothing.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import Layout, Objects
from mover.energy.config import GROWTH, Variant
from mover.energy.human_terms import SAMPLES
from mover.energy.minimize import geman_mcclure, safe_norm
from mover.geometry.boxes import Box, corners
from mover.geometry.crops import depth_in
from mover.geometry.nearest import as_float64, as_int64
from mover.geometry.placement import place
from mover.geometry.rotations import rot_y
from mover.geometry.volume import Volume, outward, sample, winding

WIDE = 96  # cells along the longest horizontal side, at most
CELL = 0.01  # [m], the smallest cell
RISE = 0.005  # [m] from section to section, at least
MOST = 2000  # sections of a solid
AROUND = 2  # cells outside, on every side


@record
class Sections:
    """Horizontal sections of a solid, in its own frame."""

    outline: Volume
    """Signed distance to the outline of the section at each height [m], negative inside; heights
    are stretched, so that cells are cubes."""
    stretch: float  #: by what


def sections_of(verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"]) -> Sections:
    """The sections of a closed mesh of one orientation; half a cell is how well they are known."""
    points, triangles = as_float64(verts), as_int64(faces)
    low, high = points.min(0), points.max(0)
    cell = max(float((high - low)[[0, 2]].max()) / WIDE, CELL)
    rise = max(float(high[1] - low[1]) / MOST, RISE)
    edges = np.array([cell, rise, cell])
    counts = np.ceil((high - low) / edges).astype(np.int64) + 2 * AROUND
    first = (low + high) / 2 - edges * (counts - 1) / 2
    inside = winding((points - first) / edges, outward(points, triangles), counts) > 0
    stretch = cell / rise
    return Sections(
        Volume(
            torch.from_numpy(_outlines(inside, cell)).to(verts),
            torch.from_numpy(first * [1.0, stretch, 1.0]).to(verts),
            cell,
        ),
        stretch,
    )


def outline(sections: Sections, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Signed distance to the outline of the section nearest in height to each point [m].

    The gradient is horizontal: nothing grows or shrinks out of a position.
    """
    volume = sections.outline
    x, y, z = points.unbind(-1)
    first = volume.origin[1].to(y)
    number = ((y.detach() * sections.stretch - first) / volume.cell).round()
    return sample(volume, torch.stack([x, first + volume.cell * number, z], -1))


def _outlines(inside: np.ndarray, cell: float) -> np.ndarray:
    """Signed distance in each section, a cell outside at most [m]; half of it is uncertain."""
    found = np.full(inside.shape, cell, dtype=np.float32)
    known: dict[bytes, np.ndarray] = {}  # many sections of a piece are the same
    for height in np.flatnonzero(inside.any((0, 2))):
        section = np.ascontiguousarray(inside[:, height])
        key = section.tobytes()
        if key not in known:
            within, beyond = 0.5 - depth_in(section), depth_in(~section).clip(max=1.5) - 0.5
            known[key] = np.where(section, within, beyond) * cell
        found[:, height] = known[key]
    return found


# --- Sizes -------------------------------------------------------------------------------------

LOWEST, HIGHEST = math.log(0.6), math.log(1.6)


def scale_term(
    log_scale: Float[Tensor, "*starts objects 3"], form: Variant, growth: float = GROWTH
) -> Float[Tensor, "*starts objects"]:
    r"""Distance of the size from the initial one [1].

    Paper: the norm as printed (its square root is rounded off below one millionth). Robust: in
    logarithms, so that half and double cost the same; an object that grows or shrinks as a whole
    costs less than half of a change of shape, and sizes beyond 0.6 or 1.6 of the initial one cost
    steeply more: \sum_k (l_k - m)^2 + g m^2 + 10 \sum_k out(l_k)^2,  m = mean l_k.
    """
    if form == "paper":
        return safe_norm(log_scale.exp() - 1)
    mean = log_scale.mean(-1, keepdim=True)
    out = (log_scale - HIGHEST).relu() + (LOWEST - log_scale).relu()
    shape = (log_scale - mean).square().sum(-1)
    return shape + growth * mean[..., 0].square() + 10 * torch.square(out).sum(-1)


# --- Distance: objects stay at the distance of the initial scene ---------------------------------
#
# A tall object whose base is hidden and that no person touches is held in depth by its size alone:
# a mask that is one pixel too wide would move it by a metre. The bound is low (Geman and McClure),
# so that this term does not count where a base is seen or people constrain more.

DISTANCE_RHO = 0.1  # of the distance


def distance_term(
    layout: Layout, given: Float[Tensor, " objects"]
) -> Float[Tensor, "*starts objects"]:
    """Cost of another distance from the camera than the given one [1]."""
    away = layout.t_world_object.square().sum(-1).clamp_min(1e-6).log() / 2
    return geman_mcclure(away - given.clamp_min(1e-3).log(), DISTANCE_RHO)


# --- Given: near the initial scene, of usual sizes, along the room -------------------------------
#
# Distances have a Student t; yaws are off by some 20 degrees, one in ten by a quarter or a half
# turn; most furniture stands along one of two directions of the room; sizes are about as given, or
# all are larger by as much as the object is farther (its picture was right), and about those of its
# class. Of objects without an initial position axis and standard dimensions alone count, these with
# the Student t: the object may be of a kind that no standard knows. d_i grows with what is left of
# the image's energy where the object fits best: the worse a shape fits, the less the image
# constrains its position, though its outline still says better than a guess which way it faces.
# Each cost is bounded or grows slowly, so that an object given metres away is found where its shape
# fits.

AWAY = 0.1  # standard deviation of the logarithm of a distance: some decimetres in a room
TURN = math.radians(20)  # of a given yaw [rad]
FLIPPED = 0.1  # share of yaws that are off by a further quarter or half turn
TURNS = 1.0  # largest weight that counts for yaws
ANY = 0.01  # and of those that are off by anything
SIZE = 0.1  # of the logarithm of each given size
COMMON = 0.06  # error that the three given sizes of an object have in common, as a logarithm
KIND = 0.5  # share of a standard's variance that the objects of one category have in common


@record
class Given:
    """What the initial scene, the room and standard dimensions say of each object."""

    distance: Float[Tensor, " objects"]  #: from the camera to the middle of the base, as given [m]
    yaw: Float[Tensor, " objects"]  #: [rad]
    along: Float[Tensor, " objects"]  #: chance that it stands along an axis of the room
    sharpness: Float[Tensor, " objects"]
    """How well those that do stand along it, and how well it is known: of a von Mises density."""
    axis: Float[Tensor, " objects"]  #: direction of an axis of the room, up to quarter turns [rad]
    standard: Float[Tensor, "objects 3"]
    """Standard sizes, as logarithms of factors on those of the mesh."""
    precision: Float[Tensor, "objects 3"]
    """How well they are known: one over the variance; 0 where there is no standard."""
    slack: Float[Tensor, "objects 3"]
    """By how much (of the logarithm) every size about the standard one is as usual."""
    weight: Float[Tensor, " objects"]
    """How little the image constrains it: 1 is usual, 0 leaves it to the image."""
    placed: bool = True
    """Whether places, yaws and sizes were given; else axes and standard sizes alone are known."""

    @cached_property
    def log_distance(self) -> Float[Tensor, " objects"]:
        """Its logarithm."""
        return self.distance.clamp_min(1e-3).log()

    @cached_property
    def unturned(self) -> Float[Tensor, " objects"]:
        """Logarithm of the density of a yaw as given."""
        return _density(torch.zeros_like(self.yaw)).log()

    @cached_property
    def level(self) -> Float[Tensor, " objects"]:
        """Density along an axis, against that of an even one."""
        return self.along / torch.special.i0e(self.sharpness)

    @cached_property
    def aligned(self) -> Float[Tensor, " objects"]:
        """Logarithm of the density of what stands along an axis, or as it likes."""
        return (1 - self.along + self.level).log()


def given_term(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    """How far positions, yaws and sizes are from what is expected [nats, times the weight]."""
    turns = given.weight.clamp_max(TURNS)
    if not given.placed:
        return turns * (_axis(layout, given) + student(_off_standard(layout, given)).sum(-1))
    yaw = given.unturned - _density(layout.yaw - given.yaw).log()
    turned = yaw + _axis(layout, given)
    position = student((_away(layout, given) / AWAY).square())
    farther = _away(layout, given).unsqueeze(-1)
    kept = layout.log_scale.square().sum(-1) / SIZE**2
    seen = (layout.log_scale - farther).square().sum(-1) / SIZE**2
    usual = _off_standard(layout, given).sum(-1)
    size = usual / 2 + math.log(2) - torch.logaddexp(-kept / 2, -seen / 2)
    return turns * turned + given.weight * (position + size)


def _axis(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    """Densities over a quarter turn, against an even one."""
    free, turned = 1 - given.along, (4 * (layout.yaw - given.axis)).cos() - 1
    return given.aligned - (free + given.level * (given.sharpness * turned).exp()).log()


def _off_standard(layout: Layout, given: Given) -> Float[Tensor, "*starts objects 3"]:
    """Squared standard deviations from the standard sizes."""
    off = ((layout.log_scale - given.standard).abs() - given.slack).relu()
    return given.precision * off.square()


def _away(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    """Logarithm of how much farther than given."""
    away = layout.t_world_object.square().sum(-1).clamp_min(1e-6).log() / 2
    return away - given.log_distance


def student(squares: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Of squared standard deviations, with three degrees of freedom."""
    return 2 * (1 + squares / 3).log()


def _density(turned: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Of being turned so far from what was given, but for a factor."""
    sharp = 1 / TURN**2
    quarters = (-turned.sin(), turned.sin(), -turned.cos())
    flipped = torch.stack([(sharp * (c - 1)).exp() for c in quarters]).sum(0)
    right = (sharp * (turned.cos() - 1)).exp()
    return (1 - FLIPPED) * right + FLIPPED / 3 * flipped + ANY


# --- Walls: furniture along a wall has its back in one line with its neighbours' ------------------
#
# r_{iw} is the root mean square of how far the two rear corners of object i lie off the line w over
# the floor; its rear is the side along its width that looks away from the camera, so that a cabinet
# that is turned round stands along the same wall. 1 - \rho (Geman and McClure) is 0 where line w
# runs across the rear: an object that stands elsewhere has a bounded cost, the same wherever it
# stands. q_{iw} says how well other objects constrain line w (`stages.objects.wall_alignment`).

WALL_RHO = 0.1  # [m]
ALONG = 0.7  # cosine between the outward directions of a rear and a line, below which they cross


@record
class Walls:
    """Lines over the floor along which furniture stands."""

    out: Float[Tensor, "walls 2"]  #: unit normal (x, z), out of the room
    offset: Float[Tensor, " walls"]  #: of its points along the normal [m]
    trust: Float[Tensor, "objects walls"]
    """How well others constrain the line, in [0, 1]; 0: it says nothing about the object."""


@record
class Rears:
    """The sides of objects that look away from the camera."""

    out: Float[Tensor, "*starts objects 2"]  #: unit normal (x, z), away from the camera
    ends: Float[Tensor, "*starts objects 2 2"]  #: the two corners over the floor (x, z) [m]


def rears_of(layout: Layout, size: Float[Tensor, "objects 3"]) -> Rears:
    """The rear side of each object; `size` is that of its mesh [m]."""
    half = size * layout.log_scale.exp() / 2
    place = layout.t_world_object[..., ::2]
    front = torch.stack([layout.yaw.sin(), layout.yaw.cos()], -1)
    away = ((front * place).sum(-1, keepdim=True) >= 0).detach().to(front) * 2 - 1
    out = front * away
    middle = place + out * half[..., 2:]
    along = torch.stack([out[..., 1], -out[..., 0]], -1) * half[..., :1]
    return Rears(out, torch.stack([middle + along, middle - along], -2))


def wall_term(
    layout: Layout, size: Float[Tensor, "objects 3"], walls: Walls
) -> Float[Tensor, "*starts objects"]:
    """Cost of standing off the lines along which other furniture stands [1]."""
    rears = rears_of(layout, size)
    off = _across(rears.ends, walls.out) - walls.offset
    apart = off.square().mean(-2)
    along = _across(rears.out.detach(), walls.out) > ALONG
    near = walls.trust * along * WALL_RHO**2 / (apart + WALL_RHO**2)
    return walls.trust.amax(-1) - near.amax(-1)


def _across(
    points: Float[Tensor, "*batch 2"], out: Float[Tensor, "walls 2"]
) -> Float[Tensor, "*batch walls"]:
    """Coordinates along the normals; no matmul, whose bits change with the number of starts."""
    x, z = out.unbind(-1)
    return points[..., :1] * x + points[..., 1:] * z


# --- Apart: objects do not stand in each other ---------------------------------------------------
#
# D_j is the horizontal way out of the closed mesh of object j, in its own frame [m]; u_i are even
# surface samples of object i, s_j the mean horizontal scale of j; h(d) = d^2 up to d = r, 2 r d -
# r^2 from there on, 0 below 0; w is 1 where object i goes on 1 cm above and below u, else 0.
# The way out is horizontal, since in a table top no point is deeper than half its thickness; from r
# on the cost rises evenly, so that a back far from the edge does not outweigh what is seen of both.
# A seat that reaches the underside of a top does so by an error of heights only: its upper side
# does not count. The term neither turns nor stretches: objects should not shrink out of each other.

OVERLAP = 0.02  # [m]
UPRIGHT = 0.01  # [m]
FAR = 0.05  # [m]


@record
class Solids:
    """What objects fill, and where they can stand in each other."""

    sections: Mapping[int, Sections]  #: of each object of a pair, in its own frame
    upright: Bool[Tensor, "objects samples"]  #: samples above and below which their object goes on
    pairs: Int[Tensor, "pairs 2"]  #: whose samples may lie in whom; on the CPU


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
    """Cost of the samples of each object that lie inside others [1]; one position an object."""
    layout = replace(layout, yaw=layout.yaw.detach(), log_scale=layout.log_scale.detach())
    points, pairs = place(objects.samples, layout), solids.pairs
    pairs = pairs[_meet(layout, objects, pairs).cpu()]
    total = torch.zeros_like(layout.yaw) + 0 * layout.t_world_object.sum(-1)  # of all positions
    pairs = pairs[pairs[:, 1].argsort(stable=True)]
    ones, others = pairs.to(points.device).unbind(-1)
    scale, turns = layout.log_scale[others], rot_y(layout.yaw[others])
    away = points[ones] - layout.t_world_object[others, None]
    own = away @ turns / scale.exp()[:, None]
    half = objects.size[others, None] / 2
    off = own.detach() - half * half.new_tensor([0.0, 1.0, 0.0])
    counts = solids.upright[ones] & (off.abs() < half + OVERLAP).all(-1)  # others are outside
    row, found = counts.nonzero()[:, 0], own[counts]
    known, number = others[row].unique_consecutive(return_counts=True)
    parts = zip(known.tolist(), found.split(number.tolist()), strict=True)
    inside = [-outline(solids.sections[k], part) for k, part in parts]  # a volume for each
    if not inside:
        return total
    deep = torch.cat(inside) * scale[:, ::2].mean(-1).exp()[row] - OVERLAP
    near = deep.relu().clamp_max(FAR)
    cost = near * (2 * deep - near) * (SAMPLES / counts.shape[1])
    return total.index_add(0, ones[row], cost)


def _meet(
    layout: Layout, objects: Objects, pairs: Int[Tensor, "pairs 2"]
) -> Bool[Tensor, " pairs"]:
    """Whether upright boxes about both boxes meet; else neither has a sample in the other."""
    size = objects.size * layout.log_scale.exp()
    middle = layout.t_world_object + size * size.new_tensor([0.0, 0.5, 0.0])
    ends = corners(Box(middle, size, layout.yaw)).detach()
    low, high = (end[pairs] for end in (ends.amin(-2), ends.amax(-2)))
    return ((low[:, 0] <= high[:, 1]) & (low[:, 1] <= high[:, 0])).all(-1)
