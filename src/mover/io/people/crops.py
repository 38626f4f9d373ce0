"""Networks that see people in square crops and give SMPL: PARE, and PHALP (of 4D-Humans).

PARE knows weak perspective; pare_output.pkl of a video or one pickle an image. Where the file has
joints in the image, the place is the one from which the true lens sees them so (least squares over
all joints); else it follows from the crop or from the whole image (`lens`).

PHALP has a square camera with a huge focal length. The networks see 256 px and assume 5000 px
there; the full image is padded to a square, so that the focal length is 5000 / 256 times its longer
side and the principal point its middle.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera
from mover.io.files.fields import At, items, mapping
from mover.io.people.found import Found, Known, joined, people_of, people_rows
from mover.io.people.lens import assumed_lens, from_crop, from_image, from_pixels, lens
from mover.io.people.values import (
    Numbers,
    angles,
    either,
    files_of,
    frames_of,
    meshes,
    natural,
    need,
    number_in,
    numbers,
    one_number,
    only_file,
    read_any,
    rows,
    stacked,
    whole,
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


# PHALP.


FOCAL, CROP = 5000.0, 256.0  # [px]


def read_phalp(path: Path, known: Known) -> Found:
    """Bodies of 4D-Humans (PHALP): the one .pkl of a folder, or the file itself."""
    at = read_any(only_file(path, "**/*.pkl", "the results of PHALP"))
    frames = mapping(at)
    found: list[Found] = []
    for index, name in enumerate(sorted(frames, key=lambda key: natural(Path(str(key))))):
        found += _frame(At(frames[name], at.file, str(name)), index, known)
    if not found:
        raise InputError(f"{at.file}: has no people in {len(frames)} frames")
    return joined(found)


def _frame(at: At, index: int, known: Known) -> list[Found]:
    """The people of one frame; those that were not seen but foretold are left out."""
    bodies, cameras = items(need(at, "smpl")), items(_list(need(at, "camera")))
    tids = whole(need(at, "tid", "tracked_ids"))
    if not len(bodies) == len(cameras) == len(tids):
        n = f"{len(tids)} tracks, {len(bodies)} bodies and {len(cameras)} cameras"
        raise InputError(f"{at.place} has {n}, expected as many of each")
    seen = _seen(at, tids)
    time = either(at, "time")
    frame = index if time is None else int(one_number(time))
    number = torch.tensor([frame if frame >= 0 else index])
    sizes = either(at, "size")
    return [
        people_rows(known, "smpl", number, int(tid), _told(body, camera), K=_lens(sizes, k, known))
        for k, (tid, body, camera) in enumerate(zip(tids, bodies, cameras, strict=True))
        if seen[k]
    ]


def _seen(at: At, tids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which people were seen in this frame, not only foretold."""
    ages, ids = either(at, "tracked_time"), either(at, "tracked_ids")
    if ages is not None and numbers(ages).size == len(tids):
        return numbers(ages).reshape(-1) == 0
    if ids is not None:
        return np.isin(tids, whole(ids))
    return np.ones(len(tids), dtype=np.bool_)


def _list(at: At) -> At:
    value = list(at.value) if isinstance(at.value, np.ndarray) else at.value
    return At(value, at.file, at.field)


def _told(body: At, camera: At) -> tuple[Numbers, Numbers, Numbers]:
    """Angles, shape and place of one person."""
    root = angles(need(body, "global_orient"), 1, 1)
    whole = np.concatenate([root, angles(need(body, "body_pose"), 1, 23)], 1)
    return whole, rows(need(body, "betas"), 1, 10), rows(camera, 1, 3)


def _lens(sizes: At | None, row: int, known: Known) -> Tensor | None:
    """The lens that was assumed for an image of this size (height, width)."""
    if sizes is None:
        return assumed_lens(known, lambda *size: FOCAL / CROP * max(size), 1)
    pairs = stacked(sizes, 2)
    height, width = (float(v) for v in pairs[min(row, len(pairs) - 1)])
    focal = known.focal or FOCAL / CROP * max(width, height)
    return lens(focal, width, height).float()[None]
