"""TRAM's result folder: camera.npy and hps/hps_track_<k>.npy, SMPL in camera axes.

`world_cam_R` turns camera axes into a world with +y up (camera to world), so that its second row
is up in the camera.
"""

import dataclasses
from pathlib import Path

import torch

from mover.io.files.fields import At
from mover.io.people.found import Found, Known, joined, pose_of
from mover.io.people.lens import cameras_of, movement, told_lens
from mover.io.people.values import angles, either, files_of, frames_of, need, read_any, rows


def read_tram(path: Path, known: Known) -> Found:
    """Bodies of TRAM.

    Raises:
        InputError: If a file or key is missing or has the wrong shape.
    """
    tracks = files_of(path, "hps/hps_track_*.npy", "TRAM's results")
    camera = (path if path.is_dir() else path.parent.parent) / "camera.npy"
    at = read_any(camera) if camera.is_file() else None
    return joined([_person(read_any(f), k, at, known) for k, f in enumerate(tracks)])


def _person(at: At, person: int, camera: At | None, known: Known) -> Found:
    whole = angles(need(at, "pred_rotmat", "pred_pose"), None, 24)
    count = len(whole)
    frame = frames_of(at, count, "frame", "frames")
    betas, place = (rows(need(at, f"pred_{k}"), count, n) for k, n in (("shape", 10), ("trans", 3)))
    found = Found(
        model="smpl",
        frame=frame,
        person=torch.full_like(frame, person),
        pose=pose_of("smpl", known.gender, whole, betas, place),
        K=None if camera is None else told_lens(camera, count),
    )
    turn = None if camera is None else either(camera, "world_cam_R")
    if camera is None or turn is None:
        return found
    R, t = cameras_of(turn, need(camera, "world_cam_T"), frame)
    warnings = movement(R.mT, -(R.mT @ t[..., None])[..., 0])
    return dataclasses.replace(found, up=R[frame, 1], warnings=warnings)
