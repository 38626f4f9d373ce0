"""Multi-HMR's people: SMPL-X meshes and angles, one list of people for each image.

The image was padded to a square and seen with 60 degrees of view unless told otherwise, so that
the focal length is longer side / (2 tan 30°). `rotvec` holds root, 21 joints of the body, 15 of
the left hand, 15 of the right, and the jaw; hands count from the flat hand; `transl_pelvis` is
the place of the pelvis.
"""

import dataclasses
import math
from pathlib import Path

import torch

from mover.bodies.smpl_model import FLAT
from mover.io.people.found import Found, Known, pose_of
from mover.io.people.lens import assumed_lens
from mover.io.people.tracks import Sighting, tracked
from mover.io.people.values import either, meshes, need, rows, tensor, wide

VERTS = 10475
VIEW = math.radians(60)
JOINTS = 53
EXTRA = {"left_hand_pose": (66, 111), "right_hand_pose": (111, 156), "jaw_pose": (156, 159)}
"""Columns of `rotvec` behind root and body."""


def read_multihmr(path: Path, known: Known) -> Found:
    """Bodies of Multi-HMR; people are followed from image to image.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    return tracked(
        path,
        known,
        lambda at: rows(need(at, "transl_pelvis", "transl"), 1, 3)[0],
        lambda seen, track: _person(seen, track, known),
    )


def _person(seen: Sighting, person: int, known: Known) -> Found:
    at = seen.at
    turns = tensor(rows(need(at, "rotvec"), 1, JOINTS * 3))
    extra = {name: turns[:, start:end] for name, (start, end) in EXTRA.items()}
    expression = either(at, "expression")
    if expression is not None:
        extra["expression"] = tensor(wide(expression, 1))
    betas = wide(need(at, "shape", "betas"), 1)
    pose = pose_of("smplx", known.gender, turns[:, :66], betas, torch.zeros(1, 3))
    return Found(
        model="smplx",
        frame=torch.tensor([seen.frame]),
        person=torch.tensor([person]),
        pose=dataclasses.replace(pose, extra={**extra, FLAT: torch.ones(1, 1)}),
        verts=meshes(either(at, "v3d", "verts_smplx", "verts_smplx_cam"), VERTS, 1),
        pelvis=tensor(rows(need(at, "transl_pelvis"), 1, 3)),
        K=assumed_lens(known, lambda *size: max(size) / (2 * math.tan(VIEW / 2)), 1),
    )
