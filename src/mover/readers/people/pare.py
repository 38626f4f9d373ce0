"""PARE's results: SMPL by weak perspective; pare_output.pkl of a video or one pickle an image.

Where the file has joints in the image, the place is the one from which the true lens sees them so
(least squares over all joints); else it follows from the crop or from the whole image (`lens`).
"""

import re
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ...records import InputError
from ...types import Camera
from ..fields import At
from .files import natural, read_any
from .found import Found, found_rows, joined, pose_of_rows
from .known import Known
from .lens import from_crop, from_image, from_pixels
from .tracks import people_of
from .values import angles, either, need, rows, tensor, whole, wide

VERTS = 6890


def read_pare(path: Path, known: Known) -> Found:
    """Bodies of PARE, of a video's file or of a folder with a file an image.

    Raises:
        InputError: If a key is missing or has the wrong shape, or the lens is not known.
    """
    if known.camera is None:
        raise InputError(f"{path.name}: PARE knows no lens: --camera names a camera.json")
    if path.is_dir() and (path / "pare_output.pkl").is_file():
        path = path / "pare_output.pkl"
    if path.is_dir():
        files = sorted(path.glob("*.pkl"), key=natural)
        if not files:
            raise InputError(f"{path}: has no .pkl files, expected PARE's results")
        return joined(
            [_image(read_any(file), _number(file, i), known) for i, file in enumerate(files)]
        )
    at = read_any(path)
    if either(at, "pred_cam") is not None:
        return _image(at, 0, known)
    return joined([_track(track, person, known) for person, track in people_of(at)])


def _number(file: Path, index: int) -> int:
    """The frame that a file's name tells, else its place in the folder."""
    digits = re.findall(r"\d+", file.stem)
    return int(digits[-1]) if digits else index


def _track(at: At, person: int, known: Known) -> Found:
    frame = torch.from_numpy(whole(need(at, "frame_ids")))
    return _rows(at, frame, torch.full_like(frame, person), known)


def _image(at: At, number: int, known: Known) -> Found:
    people = len(rows(need(at, "pred_cam"), None, 3))
    return _rows(at, torch.full((people,), number - known.first), torch.arange(people), known)


def _rows(at: At, frame: Tensor, person: Tensor, known: Known) -> Found:
    count = len(frame)
    assert known.camera is not None
    parts = {
        "whole": tensor(angles(need(at, "pose", "pred_pose"), count, 24)),
        "betas": tensor(rows(need(at, "betas", "pred_shape"), count, 10)),
        "transl": _places(at, count, known.camera),
    }
    pose = pose_of_rows("smpl", known.gender or "neutral", parts, {})
    more: dict[str, Any] = {}
    verts = either(at, "verts", "smpl_vertices")
    if verts is not None:
        flat = rows(verts, count, VERTS * 3).reshape(count, -1, 3)
        more["verts"] = tensor(flat) + parts["transl"][:, None]
    return found_rows("smpl", frame, person, pose, **more)


def _places(at: At, count: int, camera: Camera) -> Float[Tensor, "bodies 3"]:
    """Where the bodies are under the true lens [m]."""
    K = camera.K.double()
    joints, pixels = either(at, "joints3d", "smpl_joints3d"), either(at, "smpl_joints2d")
    if joints is not None and pixels is not None:
        points = torch.from_numpy(wide(joints, count).reshape(count, -1, 3).copy())
        flat = rows(pixels, count, points.shape[1] * 2, points.shape[1] * 3)
        seen = torch.from_numpy(flat.reshape(count, points.shape[1], -1)[..., :2].copy())
        return from_pixels(points, seen, K).float()
    crop, box = either(at, "pred_cam"), either(at, "bboxes")
    if crop is not None and box is not None:
        square = torch.from_numpy(rows(box, count, 4)[:, :3].copy())
        return from_crop(torch.from_numpy(rows(crop, count, 3).copy()), square, K).float()
    image = need(at, "orig_cam", "smpl_joints2d", "pred_cam")
    size = camera.width, camera.height
    return from_image(torch.from_numpy(rows(image, count, 4).copy()), K, size).float()
