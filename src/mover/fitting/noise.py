"""How large the noise of keypoints is, and what a fit makes of it.

A limb that looks too short is bent, one that looks too long cannot be: noise makes people look
larger, so that they are put too near. How much depends on how noisy their keypoints are, how large
they are seen and what they do. So the bodies that were found are seen once more with as much noise
and fitted again (a parametric bootstrap): what changes is what noise had changed before. The
share of the known noise that the fit leaves gives the size of the unknown one.
"""

import dataclasses

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.fitting.energy import HEIGHT, Seen
from mover.fitting.unknowns import Unknowns

NORMAL = 0.6745  # median of the absolute value of a normal number
FEW = 20  # rows of a person at which half of the estimated bias is applied


@record
class Bias:
    """What noise does to people."""

    betas: Float[Tensor, "people shape"]
    depth: Float[Tensor, " people"]
    """Logarithm of how much farther they are, beside what the shape says."""


def noise_of(
    off: Float[Tensor, "bodies keypoints 2"],
    seen: Seen,
    person: Int[Tensor, " bodies"],
    left: float,
) -> Float[Tensor, " bodies"]:
    """Noise of the keypoints of each body's person along each axis [px]; 0: not known.

    From the median of how far they are `off` their projections by a fit [px], so that joints which
    are swapped or guessed at the wrong place do not count. A fit leaves the share `left` of the
    variance of the noise.
    """
    noise, there = off.new_zeros(len(off)), seen.weight > 0
    for one in person.unique():
        mine = person == one
        size = off[mine][there[mine]].abs().flatten()
        if len(size):
            noise[mine] = size.median() / (NORMAL * left**0.5)
    return noise


def at_most(seen: Seen, noise: Float[Tensor, " bodies"], pose: float) -> Tensor:
    """Weights, none larger than the noise [px] allows beside a pose prior of this weight."""
    most = pose * seen.height / HEIGHT / noise.clamp_min(1e-6)
    return torch.minimum(seen.weight, most[:, None])


def bias_of(
    found: Unknowns,
    again: Unknowns,
    person: Int[Tensor, " bodies"],
    share: Float[Tensor, " bodies"],
) -> Bias:
    """What changed in the bodies `found` that were seen and fitted `again`, with noise.

    `share` is how much of the variance of that noise is really in the keypoints.
    """
    count = torch.bincount(person, minlength=len(found.betas)).to(found.place)
    moved = again.place[:, 2] - found.place[:, 2]
    each = [person == k for k in range(len(count))]
    depth = torch.stack([moved[mine].median() for mine in each])
    known = count / (count + FEW) * torch.stack([share[mine].median() for mine in each])
    return Bias(known[:, None] * (again.betas - found.betas), known * depth)


def without(at: Unknowns, bias: Bias, person: Int[Tensor, " bodies"]) -> Unknowns:
    """The bodies without what noise did to them; their poses stay."""
    place = torch.cat([at.place[:, :2], (at.place[:, 2] - bias.depth[person])[:, None]], -1)
    return dataclasses.replace(at, place=place, betas=at.betas - bias.betas)
