r"""The One-Euro filter: trembling goes where things are slow, and no lag stays where they are fast.

    x̂_t = a(f_t) x_t + (1 - a(f_t)) x̂_{t-1},  a(f) = 1 / (1 + 1 / (2 π f h)),
    f_t = f_min + β |dx̂_t|,  dx̂ the derivative, low-passed at f_d

after Casiez, Roussel and Vogel 2012 ("1€ Filter", Alg. 1 and 2), h the time between frames.
Departure: h is the real time between rows of a track, so that gaps and frame rates count as they
are; a long gap begins anew. Missing keypoints are passed over. Unordered images are not filtered.
"""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.settings import Seconds, Sigma, Weight
from mover.core.types import Bodies, Keypoints
from mover.fitting.tracks import tracks_of


@dataclass(frozen=True)
class OneEuroConfig:
    """Cut-off frequencies."""

    least: Sigma = 1.0
    """Cut-off of things that stand still [Hz]."""
    beta: Weight = 0.3
    """How much the cut-off grows with speed [Hz / (unit / s)]."""
    derivative: Sigma = 1.0
    """Cut-off of the speed [Hz]."""
    longest_gap: Seconds = 1.0
    """After such a time nothing is remembered [s]."""


KEYPOINTS = OneEuroConfig(least=3.0, beta=0.02)
"""For pixels; the authors filter with 1 Hz and 0.3 as if every video had 120 frames a second."""
PLACES = OneEuroConfig(least=1.5, beta=8.0)
"""For metres."""


def share(frequency: Tensor | float, step: Tensor) -> Tensor:
    """Weight of the new value: 0 remembers all, 1 nothing."""
    return 1 / (1 + 1 / (2 * torch.pi * torch.as_tensor(frequency).to(step) * step))


def one_euro(
    values: Float[Tensor, "rows points axes"],
    time: Float[Tensor, " rows"],
    there: Bool[Tensor, "rows points"],
    config: OneEuroConfig,
) -> Float[Tensor, "rows points axes"]:
    """Values of one track, in the order of time [s], filtered; missing ones stay as they are.

    The filter looks back only, axis by axis, as in the publication.
    """
    out = values.clone()
    last, raw, speed = values[0], values[0], torch.zeros_like(values[0])
    known, when = there[0], time[0].expand(values.shape[1]).clone()
    for k in range(1, len(values)):  # each value builds on the one before
        step = (time[k] - when).clamp_min(1e-6)[:, None].to(values)
        joined = (known & there[k] & (step[:, 0] <= config.longest_gap))[:, None]
        fresh = (values[k] - raw) / step
        quick = speed + share(config.derivative, step) * (fresh - speed)
        cut = config.least + config.beta * quick.abs()
        new = last + share(cut, step) * (values[k] - last)
        new = torch.where(joined, new, values[k])
        seen = there[k][:, None]
        out[k] = torch.where(seen, new, values[k])
        last, raw = torch.where(seen, new, last), torch.where(seen, values[k], raw)
        speed = torch.where(seen, torch.where(joined, quick, torch.zeros_like(quick)), speed)
        when = torch.where(there[k], time[k], when)
        known = known | there[k]
    return out


def smooth_keypoints(keypoints: Keypoints, config: OneEuroConfig = KEYPOINTS) -> Keypoints:
    """Keypoints of each track, filtered over real time."""
    if keypoints.fps is None:
        return keypoints
    points = keypoints.points.clone()
    there = (keypoints.confidence > 0) & points.isfinite().all(-1)
    filled = torch.where(there[..., None], points, torch.zeros_like(points))
    for rows in tracks_of(keypoints.frame, keypoints.person):
        time = keypoints.frame[rows].double() / keypoints.fps
        new = one_euro(filled[rows], time, there[rows], config)
        points[rows] = torch.where(there[rows][..., None], new, points[rows])
    return dataclasses.replace(keypoints, points=points)


def smooth_bodies(bodies: Bodies, config: OneEuroConfig = PLACES) -> Bodies:
    """Bodies moved, each as a whole, as the filtered path of their middle says."""
    if bodies.fps is None:
        return bodies
    shift = torch.zeros_like(bodies.verts[:, 0])
    middle = bodies.verts.mean(1) if bodies.joints is None else bodies.joints[:, 0]
    for rows in tracks_of(bodies.frame, bodies.person):
        time = bodies.frame[rows].double() / bodies.fps
        there = middle[rows][:, None].isfinite().all(-1)
        path = one_euro(middle[rows][:, None], time, there, config)[:, 0]
        shift[rows] = path - middle[rows]
    pose = bodies.pose
    return dataclasses.replace(
        bodies,
        verts=bodies.verts + shift[:, None],
        joints=None if bodies.joints is None else bodies.joints + shift[:, None],
        pose=None if pose is None else dataclasses.replace(pose, transl=pose.transl + shift),
    )
