"""PromptHMR's results.pkl: SMPL-X in the camera, and a world with +y up.

Its rotations of the hands are whole: they count from the flat hand.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mover.bodies.smpl_model import FLAT
from mover.io.files.fields import At
from mover.io.people.found import Found, Known, joined, pose_of
from mover.io.people.lens import cameras_of, movement, told_lens
from mover.io.people.tracks import people_of
from mover.io.people.values import angles, either, frames_of, need, read_any, rows, tensor

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
    frame = frames_of(at, count, "frames")
    betas = rows(need(body, "shape", "betas"), count, 10, 11, 16)
    place = rows(need(body, "trans", "transl"), count, 3)
    pose = pose_of("smplx", known.gender, turns[:, :BODY], betas, place)
    seen, world = either(source, "camera", "camera_world"), either(source, "camera_world")
    found = Found(
        model="smplx",
        frame=frame,
        person=torch.full_like(frame, person),
        pose=dataclasses.replace(pose, extra=_extra(turns)),
        K=None if seen is None else told_lens(seen, count),
    )
    if world is None:
        return found
    R, t = cameras_of(need(world, "Rcw"), need(world, "Tcw"), frame)
    return dataclasses.replace(found, up=R[frame][..., 1], warnings=movement(R, t))


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
