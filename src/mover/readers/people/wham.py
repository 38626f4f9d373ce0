"""WHAM's wham_output.pkl: SMPL in the camera and in a world with +y up, by track.

The names of its command line and of its Python interface differ; both are read. Where the place
is not told (`trans`), the vertices tell it. WHAM takes the image's diagonal for the focal length
where it is not told another.
"""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..fields import At
from .files import read_any
from .found import UNKNOWN, Found, found_rows, joined, pose_of_rows
from .gravity import up_of_roots
from .known import Known
from .lens import lens
from .tracks import people_of
from .values import angles, either, need, rows, tensor, whole

SMPL_VERTS = 6890


def read_wham(path: Path, known: Known) -> Found:
    """Bodies of WHAM.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    at = read_any(path / "wham_output.pkl" if path.is_dir() else path)
    return joined([_person(track, person, known) for person, track in people_of(at)])


def _person(at: At, person: int, known: Known) -> Found:
    frame = torch.from_numpy(whole(need(at, "frame_ids", "frame_id", "frames")))
    count = len(frame)
    pose, root_world = _angles(at, count)
    place = either(at, "trans", "trans_cam")
    verts = either(at, "verts", "verts_cam")
    if verts is None:
        place = need(at, "trans", "trans_cam")
    more: dict[str, Any] = {}
    if verts is not None:
        flat = rows(verts, count, SMPL_VERTS * 3)
        more["verts"] = tensor(flat.reshape(count, -1, 3))
    if root_world is not None:
        more["up"] = up_of_roots(pose[:, :3], root_world)
    if known.camera is not None:
        size = known.camera.width, known.camera.height
        used = lens(known.focal or math.hypot(*size), *size)
        more["K"] = used.float().expand(count, 3, 3)
    parts = {
        "whole": pose,
        "betas": tensor(rows(need(at, "betas"), count, 10)),
        "transl": UNKNOWN.expand(count, 3) if place is None else tensor(rows(place, count, 3)),
    }
    body = pose_of_rows("smpl", known.gender or "neutral", parts, {})
    return found_rows("smpl", frame, person, body, **more)


def _angles(at: At, count: int) -> tuple[Tensor, Tensor | None]:
    """Root and body in the camera, and the root in the world where it is told."""
    given = either(at, "pose")
    if given is not None:
        world = either(at, "pose_world")
        root = None if world is None else tensor(angles(world, count, 24)[:, :3])
        return tensor(angles(given, count, 24)), root
    need(at, "pose", "poses_body")
    root_cam = angles(need(at, "poses_root_cam"), count, 1)
    body = angles(need(at, "poses_body"), count, 23, 21)
    world = either(at, "poses_root_world")
    root = None if world is None else tensor(angles(world, count, 1))
    return torch.cat([tensor(root_cam), tensor(body)], 1), root
