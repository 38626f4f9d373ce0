"""Multi-HMR's people: SMPL-X meshes and angles, one list of people for each image.

The image was padded to a square and seen with 60 degrees of view unless told otherwise, so that
the focal length is longer side / (2 tan 30°). `rotvec` holds root, 21 joints of the body, 15 of
the left hand, 15 of the right, and the jaw; hands count from the flat hand; `transl_pelvis` is
the place of the pelvis.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...bodies.smpl_model import FLAT
from ...records import InputError
from ..fields import At
from .found import Found, found_rows, joined, pose_of_rows
from .known import Known
from .lens import lens
from .lists import Sighting, sightings
from .tracks import followed
from .values import either, need, rows, tensor, wide

VERTS = 10475
VIEW = math.radians(60)
JOINTS = 53


def read_multihmr(path: Path, known: Known) -> Found:
    """Bodies of Multi-HMR; people are followed from image to image.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    seen = sightings(path, known.first)
    if not seen:
        raise InputError(f"{path}: has no people, expected at least one")
    places = np.stack([rows(need(s.at, "transl_pelvis", "transl"), 1, 3)[0] for s in seen])
    who = followed([s.frame for s in seen], places, np.full(len(seen), 1.7))
    return joined([_person(s, int(t), known) for s, t in zip(seen, who, strict=True)])


def _person(seen: Sighting, person: int, known: Known) -> Found:
    at, frame = seen.at, torch.tensor([seen.frame])
    turns = tensor(rows(need(at, "rotvec"), 1, JOINTS * 3))
    pelvis = tensor(rows(need(at, "transl_pelvis"), 1, 3))
    extra = {
        "left_hand_pose": turns[:, 66:111],
        "right_hand_pose": turns[:, 111:156],
        "jaw_pose": turns[:, 156:159],
        FLAT: torch.ones(1, 1),
    }
    expression = either(at, "expression")
    if expression is not None:
        extra["expression"] = tensor(wide(expression, 1))
    shape = need(at, "shape", "betas")
    parts = {
        "whole": turns[:, :66],
        "betas": tensor(wide(shape, 1)),
        "transl": torch.zeros(1, 3),
    }
    pose = pose_of_rows("smplx", known.gender or "neutral", parts, extra)
    more: dict[str, Any] = {"pelvis": pelvis}
    verts = either(at, "v3d", "verts_smplx", "verts_smplx_cam")
    if verts is not None:
        more["verts"] = tensor(rows(verts, 1, VERTS * 3).reshape(1, -1, 3))
    return found_rows("smplx", frame, person, pose, **more, **_lens(at, known))


def _lens(at: At, known: Known) -> dict[str, Any]:
    """The lens of the whole image."""
    if known.camera is None:
        return {}
    size = known.camera.width, known.camera.height
    focal = known.focal or max(size) / (2 * math.tan(VIEW / 2))
    del at
    return {"K": lens(focal, *size).float()[None]}
