r"""Find the scale of a moving camera's path: people's feet tell it, since people have their size.

Not in the paper, whose camera stands still. Poses from images alone have a scale of their own; the
bodies are in metres. A foot at rest is where it was: with x its place in the axes of the camera of
its frame, and R, t the camera's pose,

    (R_j x_j - R_i x_i)  +  s (t_j - t_i)  =  0

for all pairs of frames i, j in which it rests. Which do is not known, so all pairs of both feet
over several waits are told to a robust price (Geman-McClure): feet that swing have no say. Gravity
and floor are found afterwards as for a camera that stands still (`align_camera`).

What this cannot tell: people who are all too far by a factor make the path longer by it, as they
do the room.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.parts import Parts, members
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies, CameraPath
from mover.geometry.path import poses_at
from mover.stages.config import ScaleConfig

RANGE = (-5.0, 3.0)  # logarithms of the scales that are tried, about the usual ratio
TRIED = 321
STEPS = 20  # of reweighted least squares
BLOCKS = 8  # parts of the video, each left out once for the spread
FEWEST = 20  # pairs
EVERYBODY = 1.0  # spread of a scale that nothing tells, as a share of it


@record
class ScaleInputs:
    """People in the axes of the camera of their frame, and its path."""

    bodies: Bodies
    parts: Parts
    path: CameraPath


@record
class PathScale:
    """How long the unit of the path is."""

    scale: float
    """[m]"""
    spread: float
    """Standard deviation, as a share of the scale."""
    travelled: float
    """Farthest from the reference image's camera [m]."""
    warnings: tuple[str, ...]


UNMOVED = PathScale(1.0, 0.0, 0.0, ())
"""Of a camera that stands still."""


@record
class _Pairs:
    """Two sights of one foot."""

    moved: Float[Tensor, "pairs 3"]
    """From the first to the second, were the camera turning on the spot [m]."""
    camera: Float[Tensor, "pairs 3"]
    """What the camera moved meanwhile, in units of the path."""
    block: Int[Tensor, " pairs"]
    """Part of the video."""


def find_scale(
    inputs: ScaleInputs, config: ScaleConfig = ScaleConfig(), observe: Observer = silent
) -> PathScale:
    """The scale at which most feet rest most of the time."""
    pairs = _pairs(inputs, config)
    reach = float(inputs.path.t_reference_camera.norm(dim=-1).max())
    if len(pairs.moved) < FEWEST or not float(pairs.camera.norm(dim=-1).max()) > 0:
        why = "too few frames with people tell the scale of the camera's path: taken as metres"
        return PathScale(1.0, EVERYBODY, reach, (why,))
    scale = _descended(pairs, _first(pairs, config), config)
    observe(Step("find_scale", 0, 1))
    spread = _spread(pairs, scale, config)
    warnings = ()
    if spread * scale * reach > config.loose:
        off = 100 * spread
        warnings = (
            f"the scale of the camera's path is uncertain by {off:.0f} %: feet hardly rest",
        )
    return PathScale(scale, min(spread, EVERYBODY), scale * reach, warnings)


def _pairs(inputs: ScaleInputs, config: ScaleConfig) -> _Pairs:
    """Both feet of everybody, over all waits."""
    bodies, poses = inputs.bodies, poses_at(inputs.path, inputs.bodies.frame)
    R, t = poses.R_reference_camera.double(), poses.t_reference_camera.double()
    fps = bodies.fps or 1.0
    part = bodies.frame * BLOCKS // (int(bodies.frame.max()) + 1)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for side in ("left_sole", "right_sole"):
        sole = members(inputs.parts, side)
        verts = bodies.verts[:, sole] if bool(sole.any()) else bodies.verts
        place = (R @ verts.mean(1).double()[..., None])[..., 0]
        for person in bodies.person.unique():
            rows = (bodies.person == person).nonzero()[:, 0]
            rows = rows[bodies.frame[rows].argsort()]
            for wait in config.waits:
                i, j = _apart(bodies.frame[rows], max(1, round(wait * fps)))
                i, j = rows[i], rows[j]
                found.append((place[j] - place[i], t[j] - t[i], part[i]))
    moved, camera, block = (torch.cat(column) for column in zip(*found, strict=True))
    return _Pairs(moved, camera, block)


def _apart(frame: Int[Tensor, " rows"], wait: int) -> tuple[Tensor, Tensor]:
    """Pairs of rows that are so many frames apart; the frames rise."""
    later = torch.searchsorted(frame, frame + wait).clamp_max(len(frame) - 1)
    there = frame[later] == frame + wait
    return there.nonzero()[:, 0], later[there]


def _cost(pairs: _Pairs, scale: Float[Tensor, " tried"], noise: float) -> Float[Tensor, " tried"]:
    """Share of the pairs in which the foot seems to move."""
    each = [
        ((pairs.moved + s * pairs.camera).square().sum(-1) / noise**2).double() for s in scale
    ]  # one at a time: memory stays that of one
    return torch.stack([(e / (1 + e)).mean() for e in each])


def _first(pairs: _Pairs, config: ScaleConfig) -> float:
    """The best of many scales; ties go to the smaller one, which moves nobody."""
    usual = pairs.moved.norm(dim=-1).median() / pairs.camera.norm(dim=-1).median().clamp_min(1e-9)
    tried = usual * torch.linspace(*RANGE, TRIED).double().exp()
    return float(tried[_cost(pairs, tried, 2 * config.noise).argmin()])


def _descended(pairs: _Pairs, scale: float, config: ScaleConfig) -> float:
    """Reweighted least squares from there."""
    for _ in range(STEPS):
        off = (pairs.moved + scale * pairs.camera).square().sum(-1) / config.noise**2
        weight = (1 + off).square().reciprocal()
        scale = _solved(pairs, weight)
    return scale


def _solved(pairs: _Pairs, weight: Float[Tensor, " pairs"]) -> float:
    along = (weight * (pairs.moved * pairs.camera).sum(-1)).sum()
    length = (weight * pairs.camera.square().sum(-1)).sum()
    return max(-float(along / length.clamp_min(1e-12)), 0.0)


def _spread(pairs: _Pairs, scale: float, config: ScaleConfig) -> float:
    """Jackknife over the parts of the video, as a share of the scale."""
    off = (pairs.moved + scale * pairs.camera).square().sum(-1) / config.noise**2
    weight = (1 + off).square().reciprocal()
    parts = pairs.block.unique()
    left = torch.tensor([_solved(pairs, weight * (pairs.block != part)) for part in parts])
    count = len(parts)
    variance = (count - 1) / count * (left - left.mean()).square().sum()
    return float(variance.sqrt()) / max(scale, 1e-9) if count > 1 else EVERYBODY
