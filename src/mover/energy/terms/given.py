r"""Objects stay about as they were given, of usual sizes, along the room (not in the paper).

Price:     L_given = \sum_i d_i (P_i^{place} + P_i^{size}) + \min(d_i, 1) (P_i^{yaw} + P_i^{axis}),
           each in nats
Place:     2 \log(1 + \delta^2 / 3 \sigma^2), \delta = \log \|t_i\| / \|t_i^{init}\|, a Student t: a
           guess of a distance is off by some per cent, seldom by more, never by metres.
Yaw:       the guess is off by some 20 degrees, one in ten is turned by a quarter or a half.
Axis:      most furniture stands along one of two directions of the room.
Size:      each of the three is about as large as given, or all are larger by as much as the object
           is farther (its picture was right): -\log of the mean of both chances, normal in the
           logarithms. And about as large as the standard dimensions of its class.
First:     of what nobody placed before, axis and standard dimensions alone, these with the Student
           t of places: the piece may be of a kind that no standard knows.
Weight:    d_i grows with what is left of the image's energy where the object fits best: a shape or
           a mask that does not fit says by so much less where the object stands. Which way it
           faces, the worst outline still says better than a guess.

Nothing here is hard: each price is bounded or grows slowly, so that a piece that was given metres
away or turned round is found as before where its shape fits or people tell.
"""

import math
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Layout

AWAY = 0.1  # standard deviation of the logarithm of a distance: some decimetres in a room
TURN = math.radians(20)  # of a given yaw [rad]
FLIPPED = 0.1  # share of yaws that are off by a further quarter or half turn
TURNS = 1.0  # largest weight that counts for yaws
ANY = 0.01  # and of those that are off by anything
SIZE = 0.1  # of the logarithm of each given size
COMMON = 0.06  # error that the three given sizes of an object have in common, as a logarithm


@record
class Given:
    """What the initial scene, the room and standard dimensions say of each object."""

    distance: Float[Tensor, " objects"]
    """From the camera to the middle of the base, as given [m]."""
    yaw: Float[Tensor, " objects"]
    """[rad]"""
    along: Float[Tensor, " objects"]
    """Chance that it stands along an axis of the room."""
    sharpness: Float[Tensor, " objects"]
    """How well those that do stand along it, and how well it is known: of a von Mises density."""
    axis: Float[Tensor, " objects"]
    """Direction of an axis of the room, up to quarter turns [rad]."""
    standard: Float[Tensor, "objects 3"]
    """Standard sizes, as logarithms of factors on those of the mesh."""
    precision: Float[Tensor, "objects 3"]
    """How well they are known: one over the variance; 0 where there is no standard."""
    weight: Float[Tensor, " objects"]
    """How little the image tells of it: 1 is usual, 0 leaves it to the image."""
    told: bool = True
    """Whether places, yaws and sizes were given; else axes and standard sizes alone are known."""

    # What no layout changes is computed once: descents ask hundreds of times.

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
    """How far places, yaws and sizes are from what is expected [nats, times the weight]."""
    if not given.told:
        return given.weight.clamp_max(TURNS) * (_axis(layout, given) + _standard(layout, given))
    turned = _yaw(layout, given) + _axis(layout, given)
    placed = _place(layout, given) + _size(layout, given)
    return given.weight.clamp_max(TURNS) * turned + given.weight * placed


def _away(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    """Logarithm of how much farther than given."""
    away = layout.t_world_object.square().sum(-1).clamp_min(1e-6).log() / 2
    return away - given.log_distance


def _place(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    return _student((_away(layout, given) / AWAY).square())


def _student(squares: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Of squared standard deviations, with three degrees of freedom."""
    return 2 * (1 + squares / 3).log()


def _yaw(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    return given.unturned - _density(layout.yaw - given.yaw).log()


def _density(turned: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """Of being turned so far from what was given, but for a factor."""
    sharp = 1 / TURN**2
    quarters = (-turned.sin(), turned.sin(), -turned.cos())
    flipped = torch.stack([(sharp * (c - 1)).exp() for c in quarters]).sum(0)
    right = (sharp * (turned.cos() - 1)).exp()
    return (1 - FLIPPED) * right + FLIPPED / 3 * flipped + ANY


def _axis(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    """Densities over a quarter turn, against an even one."""
    free = 1 - given.along
    turned = (4 * (layout.yaw - given.axis)).cos() - 1
    return given.aligned - (free + given.level * (given.sharpness * turned).exp()).log()


def _size(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    farther = _away(layout, given).unsqueeze(-1)
    kept = layout.log_scale.square().sum(-1) / SIZE**2
    seen = (layout.log_scale - farther).square().sum(-1) / SIZE**2
    usual = _off_standard(layout, given).sum(-1)
    return usual / 2 + math.log(2) - torch.logaddexp(-kept / 2, -seen / 2)


def _standard(layout: Layout, given: Given) -> Float[Tensor, "*starts objects"]:
    return _student(_off_standard(layout, given)).sum(-1)


def _off_standard(layout: Layout, given: Given) -> Float[Tensor, "*starts objects 3"]:
    """Squared standard deviations from the standard sizes."""
    return given.precision * (layout.log_scale - given.standard).square()
