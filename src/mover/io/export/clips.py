"""People as clips at a steady rate in a world with +z up and the floor at 0, for humanoid tools.

Readers of the humanoid chain take what they get as 30 frames a second, whatever the file says, and
know no gaps: each span in which a person is seen becomes a clip, resampled between the frames.
"""

import dataclasses
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skeleton import BODY, JOINTS
from mover.bodies.skinning import SkinnedBody, zero_pose
from mover.core.records import record
from mover.core.types import Bodies, BodyPose
from mover.geometry.rotations import axis_angle, rotation_vectors
from mover.io.export.finished import Finished
from mover.io.export.people import Track, seen_from_to, tracks_of
from mover.io.export.posed import (
    Motion,
    all_angles,
    motion_of,
    pelvis_of,
    rows_of,
    skin_of,
)
from mover.io.export.solids import AXES, floor_height

RATE = 30.0  # [1/s], what GMR and Holosoma take every clip for
PELVIS = (0.003, -0.351, 0.012)
"""Of SMPL-X's mean shape in its own axes [m]: `trans` counts from there."""
MEAN_HEIGHT, HEIGHT_STEP = 1.66, 0.1
"""[m], of SMPL-X's mean shape, and for one unit of its first shape coefficient, as GMR has it."""
BETAS = 16  # shape coefficients of AMASS


@record
class Clip:
    """One person while they are seen."""

    name: str
    time: Float[Tensor, " steps"]
    """Since the first frame of the file [s]."""
    joints: Float[Tensor, "steps joints 3"]
    """Of `JOINTS` [m], NaN where the body has no such joint."""
    height: float
    """Of the person standing straight [m]."""


@record
class PosedClip:
    """The same as parameters of SMPL-X."""

    clip: Clip
    angles: Float[Tensor, "steps 55 3"]
    trans: Float[Tensor, "steps 3"]
    betas: Float[Tensor, " betas"]
    gender: str
    exact: bool
    """Whether the result's bodies are SMPL-X's own; else only angles, height and pelvis agree."""


def clips_of(finished: Finished) -> tuple[Clip, ...] | str:
    """Everybody's joints, or why they are not known."""
    bodies = finished.bodies
    if bodies is None:
        return "the result has no bodies"
    if bodies.joints is None or not set(BODY) <= set(bodies.joint_names):
        return "the result's bodies have no joints of the names that SMPL-X gives them"
    floor = floor_height(finished.scene)
    known = [bodies.joint_names.index(n) if n in bodies.joint_names else -1 for n in JOINTS]
    places = bodies.joints.double()[:, known] @ AXES.mT
    places = places - torch.tensor([0.0, 0.0, floor], dtype=torch.float64)
    places[:, torch.tensor(known) < 0] = torch.nan
    motion = motion_of(finished)
    found: list[Clip] = []
    for track, name, time in _spans(bodies):
        rows = places[track.rows].reshape(len(track.rows), -1).numpy()
        joints = torch.from_numpy(_between(rows, track.time, time)).reshape(len(time), -1, 3)
        height = _height(bodies, motion, track)
        found.append(Clip(name, time, joints, height))
    return tuple(found)


def posed_clips_of(finished: Finished) -> tuple[PosedClip, ...] | str:
    """Everybody's parameters, or why they are not known."""
    motion, clips = motion_of(finished), clips_of(finished)
    if isinstance(motion, str) or isinstance(clips, str):
        return motion if isinstance(motion, str) else str(clips)
    assert finished.bodies is not None
    spans = _spans(finished.bodies)
    return tuple(
        _posed(motion, track, clip) for clip, (track, _, _) in zip(clips, spans, strict=True)
    )


def _spans(bodies: Bodies) -> list[tuple[Track, str, Float[Tensor, " steps"]]]:
    """Track, name of the clip and its moments, for every span in which somebody is seen."""
    found: list[tuple[Track, str, Tensor]] = []
    for track in tracks_of(bodies):
        spans = seen_from_to(track)
        for k, (start, end) in enumerate(spans):
            name = f"person_{track.person}" + (f"_{k}" if len(spans) > 1 else "")
            steps = max(1, int((end - start) * RATE + 1e-6) + 1)
            time = start + torch.arange(steps, dtype=torch.float64) / RATE
            found.append((track, name, time))
    return found


def _between(
    rows: NDArray[Any], known: Float[Tensor, " rows"], asked: Float[Tensor, " steps"]
) -> NDArray[np.float64]:
    """Values on straight lines between the rows."""
    columns = [np.interp(asked.numpy(), known.numpy(), column) for column in rows.T]
    return np.stack(columns, -1)


def _turned_between(
    vectors: Float[Tensor, "rows joints 3"],
    known: Float[Tensor, " rows"],
    asked: Float[Tensor, " steps"],
) -> Float[Tensor, "steps joints 3"]:
    """Axis-angle vectors on the shortest ways between the rows."""
    from scipy.spatial.transform import Rotation, Slerp

    if len(known) == 1:
        return vectors.double().expand(len(asked), -1, -1)
    times = np.clip(asked.numpy(), float(known[0]), float(known[-1]))
    flat = vectors.double().numpy()
    joints = [
        Slerp(known.numpy(), Rotation.from_rotvec(flat[:, k]))(times).as_rotvec()
        for k in range(flat.shape[1])
    ]
    return torch.from_numpy(np.stack(joints, 1))


def _height(bodies: Bodies, motion: Motion | str, track: Track) -> float:
    """Of the body in its zero pose at its size; of the tallest frame where that is not known."""
    if not isinstance(motion, str):
        model, pose = skin_of(motion.pose, bodies), rows_of(motion.pose, track.rows[:1])
        if model is not None:
            return _standing(model, pose) * float(motion.size[track.rows].mean())
    verts = bodies.verts[track.rows][..., 1]
    return float((verts.amax(1) - verts.amin(1)).max())


def _standing(model: SkinnedBody, pose: BodyPose) -> float:
    verts, _ = model.posed(dataclasses.replace(zero_pose(1, model), betas=pose.betas))
    return float(verts[..., 1].max() - verts[..., 1].min())


def _posed(motion: Motion, track: Track, clip: Clip) -> PosedClip:
    pose = rows_of(motion.pose, track.rows)
    angles = _turned_between(all_angles(pose), track.time, clip.time)
    turned = rotation_vectors(AXES @ axis_angle(angles[:, 0]))
    angles = torch.cat([turned[:, None], angles[:, 1:]], 1)
    exact = pose.model == "smplx"
    pelvis = clip.joints[:, 0]
    betas = torch.zeros(max(BETAS, pose.betas.shape[1] if exact else 0), dtype=torch.float64)
    if exact:
        betas[: pose.betas.shape[1]] = pose.betas.double().mean(0)
        pelvis = pelvis - pelvis_of(pose)[:1].double()
    else:
        betas[0] = (clip.height - MEAN_HEIGHT) / HEIGHT_STEP
        pelvis = pelvis - torch.tensor(PELVIS, dtype=torch.float64)
    return PosedClip(clip, angles, pelvis, betas, pose.gender, exact)
