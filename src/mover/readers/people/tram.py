"""TRAM's result folder: camera.npy and hps/hps_track_<k>.npy, SMPL in camera axes.

`world_cam_R` turns camera axes into a world with +y up (camera to world), so that its second row
is up in the camera.
"""

from pathlib import Path
from typing import Any

import torch

from ...records import InputError
from ..fields import At
from .files import natural, read_any
from .found import Found, found_rows, joined, pose_of_rows
from .gravity import movement
from .known import Known
from .lens import told_lens
from .values import angles, either, need, rows, stacked, tensor, whole


def read_tram(path: Path, known: Known) -> Found:
    """Bodies of TRAM.

    Raises:
        InputError: If a file or key is missing or has the wrong shape.
    """
    folder = path if path.is_dir() else path.parent
    files = sorted(folder.glob("hps/hps_track_*.npy"), key=natural)
    if path.is_file():
        files = [path]
        folder = path.parent.parent
    if not files:
        raise InputError(f"{path}: there is no hps/hps_track_*.npy in it, expected TRAM's results")
    camera = folder / "camera.npy"
    at = read_any(camera) if camera.is_file() else None
    return joined([_person(read_any(f), k, at, known) for k, f in enumerate(files)])


def _person(at: At, person: int, camera: At | None, known: Known) -> Found:
    turns = angles(need(at, "pred_rotmat", "pred_pose"), None, 24)
    count = len(turns)
    frame = torch.from_numpy(whole(need(at, "frame", "frames"), count))
    parts = {
        "whole": tensor(turns),
        "betas": tensor(rows(need(at, "pred_shape"), count, 10)),
        "transl": tensor(rows(need(at, "pred_trans"), count, 3)),
    }
    pose = pose_of_rows("smpl", known.gender or "neutral", parts, {})
    more = {} if camera is None else _camera(camera, frame)
    return found_rows("smpl", frame, person, pose, **more)


def _camera(at: At, frame: torch.Tensor) -> dict[str, Any]:
    """Lens, gravity and motion of the camera."""
    found: dict[str, Any] = {"K": told_lens(at, len(frame))}
    turn = either(at, "world_cam_R")
    if turn is None:
        return found
    R = tensor(stacked(turn, 3, 3))
    t = tensor(rows(need(at, "world_cam_T"), len(R), 3))
    if int(frame.max()) >= len(R):
        raise InputError(
            f"{at.file}: field 'world_cam_R' has {len(R)} frames, the bodies name {frame.max()}"
        )
    place = -(R.mT @ t[..., None])[..., 0]
    return {**found, "up": R[frame, 1], "warnings": movement(R.mT, place)}
