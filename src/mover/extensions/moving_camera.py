r"""A moving camera: its given path in metres, as people at rest constrain the scale.

Not in the paper, whose camera stands still. Poses from images alone have a scale of their own; the
bodies are in metres. What rests is where it was: with x its position in the axes of the camera of
its frame, and R, t the camera's pose,

    (R_j x_j - R_i x_i)  +  s (t_j - t_i)  =  0

for all pairs of frames i, j in which it rests. Which do is not known, so all pairs over several
waits enter a robust cost (Geman-McClure), which swinging feet and walking people do not move. Feet
and pelvis choose among many scales (the pelvis of a walker whom a camera follows rests at scale 0,
the feet do not); the pelvis alone, which errors of the pose do not move, then gives it exactly.
Gravity and floor are found afterwards as for a camera that stands still (`align_camera`).

What this cannot constrain: people who are all too far by a factor make the path longer by it, as
they do the room.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.parts import BodyParts, members, parts_of
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Bodies, CameraPath, Capture
from mover.geometry.path import is_still, poses_at, scaled
from mover.pipeline.people import carried, chosen_people
from mover.pipeline.presets import Config
from mover.stages.people.find_depth import pelvis

WAITS = (0.2, 0.4, 0.8, 1.6, 3.2)  # [s] between two sights that are compared
PELVIS = 0.03  # [m] by which a pelvis at rest usually moves between two frames
FOOT = 0.08  # [m], the same of a foot, which errors of the pose move, too
LOOSE = 0.1  # [m], an error of the farthest camera's position that deserves a warning
RANGE = (-5.0, 3.0)  # logarithms of the scales that are tried, about the usual ratio
TRIED = 321
STEPS = 20
BLOCKS = 8  # parts of the video, each left out once for the spread
DEEP = 3.0  # depths of bodies are so many times as uncertain as their pixels
FEWEST = 20  # pairs
UNKNOWN = 1.0  # spread of a scale that nothing constrains, as a share of it


def with_metric_path(capture: Capture, config: Config, run: Run) -> Capture:
    """The capture with the path of its camera in metres.

    The scale is found again after the depth of the people is corrected by their masks, along the
    path of the first scale.
    """
    bodies, path = capture.bodies, capture.path
    if bodies is None or is_still(path) or config.path == "keep":
        return capture
    parts = parts_of(bodies, capture.scene.camera.R_cam_world[:, 1])
    first = run.stage(find_scale, ScaleInputs(bodies, parts, path), None)
    capture = replace(capture, path=scaled(path, first.scale))
    bodies = chosen_people(capture, parts, config, run).bodies
    scale = run.stage(find_scale, ScaleInputs(bodies, parts, path), None)
    warnings = (*capture.warnings, *scale.warnings)
    return replace(capture, path=scaled(path, scale.scale), warnings=warnings)


def bodies_as_given(capture: Capture) -> Bodies:
    """The people as they were given, about the reference camera."""
    assert capture.bodies is not None
    if is_still(capture.path):
        return capture.bodies
    parts = parts_of(capture.bodies, capture.scene.camera.R_cam_world[:, 1])
    scale = find_scale(ScaleInputs(capture.bodies, parts, capture.path)).scale
    return carried(capture.bodies, scaled(capture.path, scale))


@record
class ScaleInputs:
    """People in the axes of the camera of their frame, and its path."""

    bodies: Bodies
    parts: BodyParts
    path: CameraPath


@record
class PathScale:
    """How long the unit of the path is."""

    scale: float  #: [m]
    spread: float  #: standard deviation, as a share of the scale
    warnings: tuple[str, ...]


@record
class _Pairs:
    """Two sights of one point of a body, in units of its noise."""

    moved: Float[Tensor, "pairs 3"]
    """From the first to the second, were the camera turning on the spot; see `_weighted`."""
    camera: Float[Tensor, "pairs 3"]
    """What the camera moved meanwhile, per unit of the path; see `_weighted`."""
    block: Int[Tensor, " pairs"]  #: part of the video


def find_scale(inputs: ScaleInputs, config: None = None, observe: Observer = silent) -> PathScale:
    """The scale at which people rest most of the time."""
    del config
    parts = [_pairs(inputs, *point) for point in _resting(inputs)]
    pairs = parts[0]
    reach = float(inputs.path.t_reference_camera.norm(dim=-1).max())
    if len(pairs.moved) < FEWEST or not float(pairs.camera.norm(dim=-1).max()) > 0:
        why = "too few frames with people give the scale of the camera's path: taken as metres"
        return PathScale(1.0, UNKNOWN, (why,))
    scale = _first(parts)
    for _ in range(STEPS):  # of reweighted least squares
        scale = _solved(pairs, (1 + _squared(pairs, scale)).square().reciprocal())
    observe(Step("find_scale", 0, 1))
    spread = _spread(pairs, scale)
    warning = (
        f"the scale of the camera's path is uncertain by {100 * spread:.0f} %: people hardly rest"
    )
    warnings = (warning,) if spread * scale * reach > LOOSE else ()
    return PathScale(scale, min(spread, UNKNOWN), warnings)


def _pairs(inputs: ScaleInputs, point: Float[Tensor, "bodies 3"], noise: float) -> _Pairs:
    """Two sights of a point of all people, over all waits."""
    bodies, poses = inputs.bodies, poses_at(inputs.path, inputs.bodies.frame)
    R, t = poses.R_reference_camera.double(), poses.t_reference_camera.double()
    fps = bodies.fps or 1.0
    block = bodies.frame * BLOCKS // (int(bodies.frame.max()) + 1)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    position = (R @ point.double()[..., None])[..., 0]
    for person in bodies.person.unique():
        rows = (bodies.person == person).nonzero()[:, 0]
        rows = rows[bodies.frame[rows].argsort()]
        frame = bodies.frame[rows]
        for wait in WAITS:
            goal = frame + max(1, round(wait * fps))
            later = torch.searchsorted(frame, goal).clamp_max(len(frame) - 1)
            there = frame[later] == goal
            i, j = rows[there], rows[later[there]]
            ray = torch.nn.functional.normalize(position[i] + position[j], dim=-1)
            moved, camera = position[j] - position[i], t[j] - t[i]
            found.append((_weighted(moved, ray) / noise, _weighted(camera, ray) / noise, block[i]))
    moved, camera, block = (torch.cat(column) for column in zip(*found, strict=True))
    return _Pairs(moved, camera, block)


def _resting(inputs: ScaleInputs) -> Iterator[tuple[Float[Tensor, "bodies 3"], float]]:
    """Points of all people that rest at times, the pelvis first, and their noise."""
    yield pelvis(inputs.bodies), PELVIS
    for side in ("left_sole", "right_sole"):
        sole = members(inputs.parts, side)
        if bool(sole.any()):
            yield inputs.bodies.verts[:, sole].mean(1), FOOT


def _weighted(
    way: Float[Tensor, "pairs 3"], ray: Float[Tensor, "pairs 3"]
) -> Float[Tensor, "pairs 3"]:
    """Ways of which the part along the ray counts by what depths are less certain (`DEEP`)."""
    return way - (1 - 1 / DEEP) * (way * ray).sum(-1, keepdim=True) * ray


def _cost(pairs: _Pairs, scale: Float[Tensor, " tried"]) -> Float[Tensor, " tried"]:
    """Share of the pairs in which the point seems to move; at twice the noise, to be wide."""
    each = [_squared(pairs, float(s)) / 4 for s in scale]  # one at a time: memory of one
    return torch.stack([(e / (1 + e)).mean() for e in each])


def _squared(pairs: _Pairs, scale: float) -> Float[Tensor, " pairs"]:
    """How far the point seems to move, in units of its noise, squared."""
    return (pairs.moved + scale * pairs.camera).square().sum(-1)


def _first(parts: list[_Pairs]) -> float:
    """The best of many scales, by all points."""
    moved = torch.cat([p.moved.norm(dim=-1) for p in parts]).median()
    camera = torch.cat([p.camera.norm(dim=-1) for p in parts]).median()
    tried = moved / camera.clamp_min(1e-9) * torch.linspace(*RANGE, TRIED).double().exp()
    costs = torch.stack([_cost(pairs, tried) for pairs in parts])
    return float(tried[costs.sum(0).argmin()])


def _solved(pairs: _Pairs, weight: Float[Tensor, " pairs"]) -> float:
    along = (weight * (pairs.moved * pairs.camera).sum(-1)).sum()
    length = (weight * pairs.camera.square().sum(-1)).sum()
    return max(-float(along / length.clamp_min(1e-12)), 0.0)


def _spread(pairs: _Pairs, scale: float) -> float:
    """Jackknife over the parts of the video, as a share of the scale."""
    weight = (1 + _squared(pairs, scale)).square().reciprocal()
    parts = pairs.block.unique()
    left = torch.tensor([_solved(pairs, weight * (pairs.block != part)) for part in parts])
    count = len(parts)
    variance = (count - 1) / count * (left - left.mean()).square().sum()
    return float(variance.sqrt()) / max(scale, 1e-9) if count > 1 else UNKNOWN
