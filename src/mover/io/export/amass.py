"""Bodies as AMASS and the tools around SMPL-X keep them: one npz a person, at a constant rate."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.geometry.rotations import axis_angle, rot_x, rotation_vectors
from mover.io.capture.pose_file import moved
from mover.io.export.finished import GAP, Exported, Finished, Up, clock_of, tracks_of
from mover.io.export.posed import Motion, all_angles, misses, motion_of, skin_of
from mover.io.files.npz import write_npz

PARTS = {"pose_body": (3, 66), "pose_jaw": (66, 69), "pose_eye": (69, 75), "pose_hand": (75, 165)}
"""Columns of the 165 angles of SMPL-X under the names that AMASS gives its parts."""


def export_amass(finished: Finished, folder: Path, up: Up = "y") -> Exported:
    """Write `amass_<person>.npz` with AMASS' keys; with z up, (x, y, z) becomes (x, -z, y).

    Rows have equal steps of time. Frames that lack the person are interpolated, but for gaps longer
    than `GAP` and than two usual steps: there a new file, `amass_<person>_<first frame>.npz`.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    motion, bodies = motion_of(finished), finished.bodies
    if isinstance(motion, str):
        raise InputError(f"--to amass: {motion}")
    assert bodies is not None
    files, notes = list[Path](), list[str]()
    if (model := skin_of(motion.pose, bodies)) is not None:
        off = misses(motion, model, bodies)
        notes.append(f"the parameters give the result's meshes within {off:.4f} m")
    if float((motion.size - 1).abs().max()) > 1e-3:
        sizes = f"{float(motion.size.min()):.3f} to {float(motion.size.max()):.3f}"
        notes.append(f"bodies are {sizes} times the size that their betas say ('size')")
    if up == "z":
        turn = rot_x(torch.tensor(torch.pi / 2)).expand(len(motion.size), 3, 3)
        motion = Motion(moved(motion.pose, turn, torch.zeros(len(motion.size), 3)), motion.size)
    for track in tracks_of(bodies):
        steps, fps, filled = track.frame.diff(), clock_of(bodies)[1], 0
        long = steps > max(GAP * fps, 2 * float(steps.median()) if len(steps) else 0.0)
        cuts, step = long.nonzero()[:, 0] + 1, math.gcd(*steps[~long].tolist()) or 1
        pieces = (x.tensor_split(cuts) for x in (track.frame, track.rows))
        for frame, rows in zip(*pieces, strict=True):
            every = torch.arange(int(frame[0]), int(frame[-1]) + 1, step)
            name = f"amass_{track.person}" + (f"_{int(frame[0]):06d}" if len(cuts) else "")
            files.append(folder / f"{name}.npz")
            more = {"up_axis": np.array(up), "person": np.array(track.person)}
            even = _even(motion, rows, frame, every)
            write_npz({**_arrays(even, every, fps / step), **more}, files[-1])
            filled += len(every) - len(frame)
        if filled:
            notes.append(f"person {track.person}: {filled} frames without the person interpolated")
        if len(cuts):
            notes.append(f"person {track.person}: {len(cuts) + 1} files, cut at long gaps")
    return Exported(tuple(files), tuple(notes))


def _even(
    motion: Motion, rows: Int[Tensor, " rows"], frame: Int[Tensor, " rows"],
    every: Int[Tensor, " frames"],
) -> Motion:  # fmt: skip
    """The motion of one person in every frame: between its rows it goes the straight way."""
    after = torch.searchsorted(frame, every)
    before = (after - 1).clamp_min(0)
    share = (1 - (frame[after] - every) / (frame[after] - frame[before]).clamp_min(1))[:, None]

    def straight(values: Tensor) -> Tensor:
        return torch.lerp(values[rows[before]], values[rows[after]], share.to(values))

    def turned(values: Tensor) -> Tensor:
        start, end = (axis_angle(values[rows[k]].reshape(-1, 3).double()) for k in (before, after))
        way = rotation_vectors(start.mT @ end) * share.repeat_interleave(values.shape[1] // 3, 0)
        turns = rotation_vectors(start @ axis_angle(way)).reshape(len(every), -1)
        return torch.where(share < 1, turns.to(values), values[rows[after]])

    pose, joints = motion.pose, (3, 45)  # numbers of jaw, eye and hand; other numbers are no turns
    even = replace(
        pose, betas=straight(pose.betas), transl=straight(pose.transl),
        global_orient=turned(pose.global_orient), body_pose=turned(pose.body_pose),
        extra={k: (turned if x.shape[1] in joints else straight)(x) for k, x in pose.extra.items()},
    )  # fmt: skip
    return Motion(even, straight(motion.size[:, None])[:, 0])


def _arrays(motion: Motion, frame: Int[Tensor, " frames"], fps: float) -> dict[str, NDArray[Any]]:
    """One person; rows are frames of the video, whose numbers are in `frame`."""
    pose = motion.pose
    if pose.model == "smpl":  # all angles in the model's own order
        angles = torch.cat([pose.global_orient, pose.body_pose], -1)
    else:
        angles = all_angles(pose).flatten(1)
        if pose.model == "smplh":  # has no jaw and no eyes
            angles = torch.cat([angles[:, :66], angles[:, 75:]], -1)
    poses, rate = angles.numpy(), np.array(fps)
    shape = pose.betas.double().mean(0).numpy()
    parts = PARTS.items() if poses.shape[1] == 165 else ()
    return {
        "trans": pose.transl.numpy(), "root_orient": pose.global_orient.numpy(),
        "poses": poses, "betas": shape, "num_betas": np.array(len(shape)),
        "gender": np.array(pose.gender), "mocap_framerate": rate, "mocap_frame_rate": rate,
        "surface_model_type": np.array(pose.model), "frame": frame.numpy(),
        "size": motion.size.numpy(),
        **{name: values.numpy() for name, values in pose.extra.items()},
        **{name: poses[:, start:end] for name, (start, end) in parts},
    }  # fmt: skip
