r"""Find how far a moving camera's path has drifted up or down: standing feet tell it.

Not in the paper, whose camera stands still. Poses of SLAM walk away from the truth by about one
per cent of the way. What is wrong with the height of the camera is wrong with that of everybody's
feet, at every place of the room; a wrong gravity, in contrast, is the same at all times. Both are
found together, by reweighted least squares over pitch, roll, the floor and the drift d at knots in
time,

    \sum_i w_i rho(h_i + d(t_i))  +  \sum_k (d_{k+1} - d_k)^2 / v_k,     v_k = (share^2 / 3) W W_k

with h the heights of feet above the floor, W the way of the camera and W_k that between two knots;
d is zero at the reference image. It moves the path, so that `align_camera` finds pitch, roll and
floor as for a camera that stands still. Sideways drift is told by no foot and stays.
"""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Camera, CameraPath
from mover.energy.terms.feet import FootContacts, heights, up_cam
from mover.geometry.camera import pitch_roll, tilted
from mover.stages.camera.config import DriftConfig
from mover.stages.camera.foot_votes import Votes, vote

STEPS = 12  # for each scale of the robust price
FIXED = 1e-4  # [m], how well the height at the reference image is known
UNKNOWN = 0.5  # [rad], [m], spread where no foot tells anything
LEAST_WAY = 1e-3  # [m] between two knots


@record
class DriftInputs:
    """Feet at rest, about the reference image's camera, and the path that put them there [m]."""

    foot_contacts: FootContacts
    camera: Camera
    """Its pitch and roll are the first guess."""
    path: CameraPath
    fps: float


@record
class Drift:
    """By how much the path is too low."""

    frame: Int[Tensor, " knots"]
    height: Float[Tensor, " knots"]
    """To be added along the world's up [m]."""
    up: Float[Tensor, "3"]
    """That up, in the axes of the reference image's camera."""
    covariance: Float[Tensor, "3 3"]
    """Of pitch [rad], roll [rad] and ground [m], as far as the drift is not known."""
    warnings: tuple[str, ...]


def find_drift(
    inputs: DriftInputs, config: DriftConfig = DriftConfig(), observe: Observer = silent
) -> Drift:
    """The slow heights that put most standing feet on one floor."""
    knots = _knots(inputs.path, max(1, round(config.every * inputs.fps)))
    first = torch.stack(pitch_roll(inputs.camera.R_cam_world.double()))
    if len(inputs.foot_contacts.person):
        votes = vote(inputs.foot_contacts, "places")
        shares = shares_of(votes.foot_contacts.frame, knots)
        ground = (votes.foot_contacts.points_cam @ tilted(first[0], first[1])[:, 1]).median()
        at = torch.cat([first, ground[None], torch.zeros(len(knots)).double()])
        trust = _trust(inputs.path, knots, config)
        bend = torch.eye(len(at)).double()
        for sigma in config.sigmas:
            for _ in range(STEPS):
                at, bend = _step(at, votes, shares, (first, sigma, trust, config.tilt_prior))
    else:
        at = torch.cat([first, torch.zeros(1 + len(knots)).double()])
        bend = torch.eye(len(at)).double() / UNKNOWN**2
    observe(Step("find_drift", 0, 1))
    up, height = up_cam(at[0], at[1]).float(), at[3:].float()
    most = float(height.abs().max())
    told = f"the camera's path is corrected by up to {100 * most:.0f} cm of height: it drifts"
    spread = torch.linalg.inv(bend)[:3, :3].float()
    return Drift(knots, height, up, spread, (told,) if most > config.loose else ())


def undrifted(path: CameraPath, drift: Drift) -> CameraPath:
    """The path without it."""
    lift = shares_of(path.frame, drift.frame).to(drift.height) @ drift.height
    at = path.t_reference_camera + lift[:, None] * drift.up
    return dataclasses.replace(path, t_reference_camera=at)


def _knots(path: CameraPath, every: int) -> Int[Tensor, " knots"]:
    first, last = int(path.frame[0]), int(path.frame[-1])
    count = max(2, 1 + math.ceil((last - first) / every))
    return torch.linspace(first, last, count).round().long()


def home_of(path: CameraPath) -> Int[Tensor, ""]:
    """The frame whose camera is most like that of the reference image."""
    return path.frame[(path.R_reference_camera - torch.eye(3)).abs().amax((1, 2)).argmin()]


def shares_of(
    frame: Int[Tensor, " rows"], knots: Int[Tensor, " knots"]
) -> Float[Tensor, "rows knots"]:
    """How much each knot has of a time between two; float64."""
    after = torch.searchsorted(knots, frame).clamp(1, len(knots) - 1)
    low, high = knots[after - 1], knots[after]
    share = ((frame - low).double() / (high - low)).clamp(0, 1)[:, None]
    whole = torch.nn.functional.one_hot(torch.stack([after - 1, after]), len(knots)).double()
    return (1 - share) * whole[0] + share * whole[1]


def _trust(
    path: CameraPath, knots: Int[Tensor, " knots"], config: DriftConfig
) -> Float[Tensor, "knots knots"]:
    """What is believed of the drift before any foot is seen: one over its covariance [1/m²]."""
    t = path.t_reference_camera.double()
    step = torch.nn.functional.pad(t.diff(dim=0).norm(dim=-1), (1, 0)).cumsum(0)
    index = torch.searchsorted(path.frame, knots).clamp_max(len(step) - 1)
    between = step[index].diff().clamp_min(LEAST_WAY)
    change = torch.eye(len(knots)).double().diff(dim=0)
    walk = 3 / (config.share**2 * between * between.sum())
    still = shares_of(home_of(path)[None], knots)
    return change.mT @ (walk[:, None] * change) + still.mT @ still / FIXED**2


def _step(
    at: Float[Tensor, " unknowns"],
    votes: Votes,
    shares: Float[Tensor, "soles knots"],
    belief: tuple[Tensor, float, Tensor, float],
) -> tuple[Float[Tensor, " unknowns"], Float[Tensor, "unknowns unknowns"]]:
    """One step of Gauss-Newton with the weights of Geman-McClure, and the curvature there."""
    first, sigma, trust, tilt = belief
    pitch, roll = at[:2]
    points = votes.foot_contacts.points_cam
    residual = heights(points, tilted(pitch, roll), at[2]) + shares @ at[3:]
    up = up_cam(pitch, roll)
    by_roll = torch.stack([up[1], -up[0], torch.zeros_like(pitch)])
    turns = [points @ up_cam(pitch + math.pi / 2, roll), points @ by_roll]
    slope = torch.cat([torch.stack([*turns, -torch.ones_like(residual)], -1), shares], -1)
    pull = votes.weight / (1 + (residual / sigma).square()).square()
    prior = torch.zeros(len(at), len(at)).double()
    prior[0, 0] = prior[1, 1] = tilt**-2
    prior[3:, 3:] = trust
    centre = torch.cat([first, at[2:3], torch.zeros_like(at[3:])])
    hessian = slope.mT @ (pull[:, None] * slope) + prior
    gradient = slope.mT @ (pull * residual) + prior @ (at - centre)
    return at - torch.linalg.solve(hessian + 1e-6 * hessian.diag().diag(), gradient), hessian
