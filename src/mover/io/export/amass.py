"""Bodies as AMASS and the tools around SMPL-X keep them: one npz a person."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Bodies
from mover.geometry.rotations import rot_x
from mover.io.capture.pose_file import moved
from mover.io.export.finished import Exported, Finished, Track, Up, clock_of, tracks_of
from mover.io.export.posed import Motion, all_angles, misses, motion_of, skin_of
from mover.io.files.npz import write_npz

PARTS = {"pose_body": (3, 66), "pose_jaw": (66, 69), "pose_eye": (69, 75), "pose_hand": (75, 165)}
"""Columns of the 165 angles of SMPL-X under the names that AMASS gives its parts."""


def export_amass(finished: Finished, folder: Path, up: Up = "y") -> Exported:
    """Write `amass_<person>.npz` with AMASS' keys; with z up, (x, y, z) becomes (x, -z, y).

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
        files.append(folder / f"amass_{track.person}.npz")
        write_npz({**_arrays(motion, track, bodies), "up_axis": np.array(up)}, files[-1])
    return Exported(tuple(files), tuple(notes))


def _arrays(motion: Motion, track: Track, bodies: Bodies) -> dict[str, NDArray[Any]]:
    """One person; rows are frames of the video, whose numbers are in `frame`."""
    pose, rows = motion.pose, track.rows
    if pose.model == "smpl":  # all angles in the model's own order
        angles = torch.cat([pose.global_orient, pose.body_pose], -1)
    else:
        angles = all_angles(pose).flatten(1)
        if pose.model == "smplh":  # has no jaw and no eyes
            angles = torch.cat([angles[:, :66], angles[:, 75:]], -1)
    poses = angles[rows].numpy()
    steps = track.frame.diff()
    rate = np.array(clock_of(bodies)[1] / (int(steps.median()) if len(steps) else 1))
    shape = pose.betas[rows].double().mean(0).numpy()
    parts = PARTS.items() if poses.shape[1] == 165 else ()
    return {
        "trans": pose.transl[rows].numpy(), "root_orient": pose.global_orient[rows].numpy(),
        "poses": poses, "betas": shape, "num_betas": np.array(len(shape)),
        "gender": np.array(pose.gender), "mocap_framerate": rate, "mocap_frame_rate": rate,
        "surface_model_type": np.array(pose.model), "frame": track.frame.numpy(),
        "size": motion.size[rows].numpy(),
        **{name: values[rows].numpy() for name, values in pose.extra.items()},
        **{name: poses[:, start:end] for name, (start, end) in parts},
    }  # fmt: skip
