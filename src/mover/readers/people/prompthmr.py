"""PromptHMR's results.pkl: SMPL-X in the camera, and a world with +y up.

Its rotations of the hands are whole: they count from the flat hand.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...bodies.smpl_model import FLAT
from ...records import InputError
from ..fields import At
from .files import read_any
from .found import Found, found_rows, joined, pose_of_rows
from .gravity import movement
from .known import Known
from .lens import told_lens
from .tracks import people_of
from .values import angles, either, need, rows, stacked, tensor, whole

BODY = 66  # angles of root and body
JAW, HANDS = slice(66, 69), slice(75, 165)


def read_prompthmr(path: Path, known: Known) -> Found:
    """Bodies of PromptHMR.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    at = read_any(path / "results.pkl" if path.is_dir() else path)
    people = people_of(need(at, "people"))
    return joined([_person(one, person, at, known) for person, one in people])


def _person(at: At, person: int, source: At, known: Known) -> Found:
    body = need(at, "smplx_cam")
    turns = angles(need(body, "rotmat", "pose"), None, 55, 25, 22)
    count = len(turns)
    frame = torch.from_numpy(whole(need(at, "frames"), count))
    parts = {
        "whole": tensor(turns[:, :BODY]),
        "betas": tensor(rows(need(body, "shape", "betas"), count, 10, 11, 16)),
        "transl": tensor(rows(need(body, "trans", "transl"), count, 3)),
    }
    pose = pose_of_rows("smplx", known.gender or "neutral", parts, _extra(turns))
    return found_rows("smplx", frame, person, pose, **_camera(source, frame))


def _extra(turns: np.ndarray) -> dict[str, Tensor]:
    """Jaw and hands where they are told."""
    found: dict[str, Tensor] = {}
    if turns.shape[1] >= JAW.stop:
        found["jaw_pose"] = tensor(turns[:, JAW])
    if turns.shape[1] >= HANDS.stop:
        left, right = np.split(turns[:, HANDS], 2, axis=1)
        found |= {"left_hand_pose": tensor(left), "right_hand_pose": tensor(right)}
        found[FLAT] = torch.ones(len(turns), 1)
    return found


def _camera(at: At, frame: Tensor) -> dict[str, Any]:
    """Lens, gravity and motion of the camera."""
    found: dict[str, Any] = {}
    seen = either(at, "camera", "camera_world")
    if seen is not None:
        found["K"] = told_lens(seen, len(frame))
    world = either(at, "camera_world")
    if world is None:
        return found
    R = tensor(stacked(need(world, "Rcw"), 3, 3))
    t = tensor(rows(need(world, "Tcw"), len(R), 3))
    if int(frame.max()) >= len(R):
        raise InputError(
            f"{at.file}: field 'camera_world.Rcw' has {len(R)} frames, people name {frame.max()}"
        )
    return {**found, "up": R[frame][..., 1], "warnings": movement(R, t)}
