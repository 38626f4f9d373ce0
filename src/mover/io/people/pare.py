"""PARE's results: SMPL by weak perspective; pare_output.pkl of a video or one pickle an image.

Where the file has joints in the image, the place is the one from which the true lens sees them so
(least squares over all joints); else it follows from the crop or from the whole image (`lens`).
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera
from mover.io.files.fields import At
from mover.io.people.found import Found, Known, joined, people_rows
from mover.io.people.lens import from_crop, from_image, from_pixels
from mover.io.people.tracks import people_of
from mover.io.people.values import (
    angles,
    either,
    files_of,
    frames_of,
    meshes,
    need,
    number_in,
    read_any,
    rows,
    wide,
)

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
        files = files_of(path, "*.pkl", "PARE's results")
        numbers = [number_in(file.stem, index) for index, file in enumerate(files)]
        return joined([_image(read_any(f), n, known) for f, n in zip(files, numbers, strict=True)])
    at = read_any(path)
    if either(at, "pred_cam") is not None:
        return _image(at, 0, known)
    return joined([_track(track, person, known) for person, track in people_of(at)])


def _track(at: At, person: int, known: Known) -> Found:
    frame = frames_of(at, None, "frame_ids")
    return _rows(at, frame, torch.full_like(frame, person), known)


def _image(at: At, number: int, known: Known) -> Found:
    people = len(rows(need(at, "pred_cam"), None, 3))
    return _rows(at, torch.full((people,), number - known.first), torch.arange(people), known)


def _rows(at: At, frame: Tensor, person: Tensor, known: Known) -> Found:
    count = len(frame)
    assert known.camera is not None
    whole = angles(need(at, "pose", "pred_pose"), count, 24)
    betas = rows(need(at, "betas", "pred_shape"), count, 10)
    place = _places(at, count, known.camera)
    verts = meshes(either(at, "verts", "smpl_vertices"), VERTS, count)
    placed = None if verts is None else verts + place[:, None]
    return people_rows(known, "smpl", frame, person, (whole, betas, place), verts=placed)


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
