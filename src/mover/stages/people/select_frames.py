r"""Leave out frames whose body cannot be right (Sec. 3.2, "Initial Estimate of 3D Bodies").

Paper:     {j : nu_j < tau_pelvis and alpha_j < tau_local}, nu and alpha the accelerations of the
           pelvis and of the joints relative to it.
Reading:   A body departs from constant velocity because it is pushed (metres per second squared)
           and because it is estimated frame by frame (metres). So the limit on the second
           difference is `jitter + acceleration * h^2`, h the time between frames: 0.21 m for the
           pelvis at 30 frames a second (authors: 0.18 m at any rate) and 0.6 m at 5, where
           an honest step down makes 0.31 m and a jump by half a metre 1 m. Local joints are
           measured by the mean of their lengths: their mean vector, which the authors' code
           takes, does not see that left and right are swapped.
Departure: A wrong frame also spoils the second differences of its neighbours. `chain` keeps the
           longest sequence of frames that is consistent; `each` judges every frame by itself.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies
from mover.stages.config import SelectConfig

LOCAL = (
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_hip", "right_hip", "left_knee", "right_knee",
)  # fmt: skip
SPREAD_VERTS = 32  # vertices that stand for the joints of a body without any
PELVIS_ACCELERATION = 10.0  # [m/s²], what a pelvis does when one jumps off a step
PELVIS_JITTER = 0.2  # [m], second difference of the pelvis that noise explains
LOCAL_ACCELERATION = 8.0  # [m/s²], mean of shoulders, elbows, hips, knees relative to the pelvis
LOCAL_JITTER = 0.16  # [m], its second difference that noise explains
REACH = 13  # frames in a row that may be left out
CUT = 6.0  # frames that are rather left out than that a track jumps

Points = Float[np.ndarray, "frames points 3"]


@record
class Selection:
    """Which rows of the bodies give evidence."""

    keep: Bool[Tensor, " bodies"]


def select_frames(
    bodies: Bodies, config: SelectConfig = SelectConfig(), observe: Observer = silent
) -> Selection:
    """Find the frames in which a person moves as a person can.

    Each track is judged by itself, at its real times, so that gaps do no harm. Unordered images and
    tracks of fewer than three frames are kept whole.
    """
    keep = np.ones(len(bodies.frame), dtype=bool)
    if bodies.fps is None:
        return Selection(torch.from_numpy(keep))
    frame, persons = bodies.frame.cpu().numpy(), bodies.person.cpu().numpy()
    points, tracks = _points(bodies), np.unique(persons)
    for index, person in enumerate(tracks):
        rows = np.flatnonzero(persons == person)
        rows = rows[np.argsort(frame[rows], kind="stable")]
        if len(rows) >= 3:
            time, inner = frame[rows] / bodies.fps, np.arange(1, len(rows) - 1)
            if config.rule == "each":
                strain = _strain(time, points[rows], inner - 1, inner, inner + 1)
                keep[rows[1:-1]] = strain < 1
            else:
                keep[rows] = _longest(time, points[rows])
        observe(Step("select_frames", index, len(tracks)))
    return Selection(torch.from_numpy(keep).to(bodies.frame.device))


def _points(bodies: Bodies) -> Points:
    """The pelvis, and then the other points relative to it [m]; without joints from vertices."""
    names = bodies.joint_names
    if bodies.joints is not None and {"pelvis", *LOCAL} <= set(names):
        points = bodies.joints[:, [names.index(n) for n in ("pelvis", *LOCAL)]]
    else:
        picked = torch.linspace(0, bodies.verts.shape[1] - 1, SPREAD_VERTS).round().long()
        centre = bodies.verts.mean(1, keepdim=True)
        points = torch.cat([centre, bodies.verts[:, picked.to(centre.device)]], 1)
    points = torch.cat([points[:, :1], points[:, 1:] - points[:, :1]], 1)
    return points.detach().cpu().double().numpy()


def _strain(
    time: np.ndarray, points: Points, i: np.ndarray, j: np.ndarray, k: np.ndarray
) -> np.ndarray:
    """Second difference over its limit at the middle of three frames; above 1 no motion is so."""
    h1, h2 = time[j] - time[i], time[k] - time[j]
    to_i, to_k = h2 / (h1 + h2), h1 / (h1 + h2)
    straight = points[i] * to_i[..., None, None] + points[k] * to_k[..., None, None]
    second, area = 2 * (points[j] - straight), h1 * h2  # a h1 h2 [m]
    pelvis, joints = np.linalg.norm(second[..., 0, :], axis=-1), second[..., 1:, :]
    local = np.linalg.norm(joints, axis=-1).mean(-1)
    return np.maximum(
        pelvis / (PELVIS_JITTER + PELVIS_ACCELERATION * area),
        local / (LOCAL_JITTER + LOCAL_ACCELERATION * area),
    )


def _longest(time: np.ndarray, points: Points) -> np.ndarray:
    """The sequence with the fewest frames left out in which no three neighbours exceed the limit.

    Shortest path: `pair[b, k]` is the least cost of a sequence that ends with frames k - 1 - b
    and k. A frame left out costs 1, a jump of the track `CUT`.
    """
    n, back = len(time), np.arange(REACH)
    pair = np.full((REACH, n), np.inf)  # cost of (k - 1 - b, k)
    came = np.full((REACH, n), -1)  # b of the frame before k - 1 - b; -1: a sequence starts there
    alone, before = np.zeros(n), np.full(n, -1)  # cost of beginning with k, and the frame before
    for j in range(n):
        alone[j] = j
        if j:
            jump = np.minimum(alone[:j], pair[:, :j].min(0)) + (j - 1 - np.arange(j)) + CUT
            last = int(jump.argmin())
            if jump[last] < j:
                alone[j], before[j] = jump[last], last
        k = j + 1 + back[: max(0, min(REACH, n - 1 - j))]
        if not len(k):
            continue
        i = j - 1 - back[: min(REACH, j)]
        cost = np.full((len(i) + 1, len(k)), alone[j])
        if len(i):
            i2, k2 = np.broadcast_arrays(i[:, None], k[None, :])
            strain = _strain(time, points, i2, np.full_like(i2, j), k2)
            cost[1:] = np.where(strain < 1, pair[: len(i), j][:, None] + 1e-3 * strain, np.inf)
        best = cost.argmin(0)
        pair[k - 1 - j, k] = cost[best, np.arange(len(k))] + (k - 1 - j)
        came[k - 1 - j, k] = best - 1
    keep = np.zeros(n, dtype=bool)
    k = int((np.minimum(alone, pair.min(0)) + (n - 1 - np.arange(n))).argmin())
    while k >= 0:  # back along the best path
        keep[k] = True
        b = int(pair[:, k].argmin())
        if alone[k] <= pair[b, k]:
            k = int(before[k])
            continue
        while b >= 0:
            k, b = k - 1 - b, int(came[b, k])
            keep[k] = True
        k = int(before[k])
    return keep
