"""Fits by optimisation: those of SMPLify-X, PROX and MOVER, and SLAHMR's.

The former are SMPL-X parameters in pickles, by frame or for a whole video.

SMPLify-X keeps the place of the body in its camera (`camera_rotation`, `camera_translation`) and
assumes 5000 px; PROX and MOVER keep it in `transl` under the true lens. PROX's images are stored
mirrored and were mirrored back before the fit.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover.core.errors import InputError
from mover.io.files.fields import At, refuse
from mover.io.people.found import Found, Known, chosen, joined, people_of, people_rows, shifted
from mover.io.people.lens import assumed_lens, movement
from mover.io.people.values import (
    either,
    files_of,
    frame_numbers,
    need,
    numbers,
    one_number,
    read_any,
    rows,
    stacked,
    tensor,
    wide,
)

FOCAL = 5000.0  # [px], SMPLify-X's default
CODE = 32  # numbers of a VPoser code
EXTRA = ("left_hand_pose", "right_hand_pose", "jaw_pose", "expression")
GENDERS = ("neutral", "female", "male")


def read_smplifyx(path: Path, known: Known) -> Found:
    """Fits of SMPLify-X: results/<frame>/<person>.pkl, or one such file."""
    return _read(path, known, assumed=True)


def read_prox(path: Path, known: Known) -> Found:
    """Fits of PROX: results/<frame>/000.pkl, under the true lens."""
    return _read(path, known, assumed=False)


def read_mover(path: Path, known: Known) -> Found:
    """Fits of the authors' MOVER: 001_all.pkl of a video, or a file a frame."""
    if path.is_dir() and (path / "001_all.pkl").is_file():
        path = path / "001_all.pkl"
    return _read(path, known, assumed=False)


def _read(path: Path, known: Known, assumed: bool) -> Found:
    files = files_of(path, "**/*.pkl", "fits")
    if not path.is_dir():
        return joined([_rows(read_any(files[0]), 0, 0, known, assumed)])
    places = [_place_in(file) for file in files]
    frames = known.frames
    if frames is None:
        numbers = frame_numbers((name for name, _ in places), path.name)
        frames = {name: number - known.first for name, number in numbers.items()}
    parts: list[Found] = []
    for file, (name, person) in zip(files, places, strict=True):
        if name not in frames:
            raise InputError(f"{file}: {name!r} is no frame of the recording")
        parts.append(_rows(read_any(file), frames[name], person, known, assumed))
    return joined(parts)


def _place_in(file: Path) -> tuple[str, int]:
    """Name of the frame, and person, of `<frame>/<person>.pkl` or `<frame>.pkl`."""
    if re.fullmatch(r"\d{1,3}", file.stem) and re.search(r"\d", file.parent.name):
        return file.parent.name, int(file.stem)
    return file.stem, 0


def _rows(at: At, frame: int, person: int, known: Known, assumed: bool) -> Found:
    root = tensor(rows(need(at, "global_orient"), None, 3))
    count = len(root)
    turn, shift = either(at, "camera_rotation"), either(at, "camera_translation")
    place = either(at, "transl")
    if place is None:
        shift = need(at, "camera_translation", "transl")
    zero = torch.zeros(count, 3)
    whole = torch.cat([root, _body(need(at, "body_pose"), count, known)], 1)
    told = whole, wide(need(at, "betas"), count), zero if place is None else rows(place, count, 3)
    extra = {n: tensor(wide(v, count)) for n in EXTRA if (v := either(at, n)) is not None}
    flat = np.eye(3).reshape(1, 9).repeat(count, 0) if turn is None else rows(turn, count, 9)
    R = tensor(flat).reshape(-1, 3, 3)
    t = zero if shift is None else tensor(rows(shift, count, 3))
    known = dataclasses.replace(known, gender=known.gender or _gender(at))
    found = people_rows(
        known, "smplx", torch.arange(frame, frame + count), person, told, extra,
        K=assumed_lens(known, FOCAL, count) if assumed else None,
    )  # fmt: skip
    return shifted(found, R, t)


def _body(at: At, count: int, known: Known) -> Tensor:
    """The 21 joints of the body; VPoser's codes are decoded where its weights are known."""
    given = wide(at, count)
    if given.shape[1] != CODE:
        return tensor(rows(at, count, 63))
    if known.decode is None:
        refuse(
            at,
            "63 angles: SMPLify-X stored VPoser's code, which its decoder turns into angles "
            "(vposer.decode(body_pose, output_type='aa')); store these instead, or name VPoser's "
            "weights (--vposer)",
            f"{CODE} numbers",
        )
    with torch.no_grad():
        return known.decode(tensor(given))


def _gender(at: At) -> str:
    given = either(at, "gender")
    if given is None:
        return "neutral"
    value: Any = given.value.tolist() if isinstance(given.value, np.ndarray) else given.value
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    word = value.decode() if isinstance(value, bytes) else str(value)
    if word not in GENDERS:
        refuse(given, "one of " + ", ".join(GENDERS))
    return word


# SLAHMR's *_world_results.npz: SMPL-H in a world, with the cameras (x_cam = R x + t).
#
# Its world has the first camera's axes, so that -y is roughly up; the ground's plane, normal times
# offset, tells it exactly, up to a sign that -y decides.


LEAST_OFFSET = 1e-4  # [m], a plane through the origin tells no direction
UP = (0.0, -1.0, 0.0)


def read_slahmr(path: Path, known: Known) -> Found:
    """Bodies of SLAHMR, in the cameras of their frames; of a folder the last result."""
    path = files_of(path, "**/*_world_results.npz", "SLAHMR's results")[-1]
    at = read_any(path)
    place = numbers(need(at, "trans"))
    if place.ndim != 3 or not place.size:
        raise InputError(f"{at.file}: field 'trans' has shape {place.shape}, expected (B, T, 3)")
    people, frames = place.shape[:2]
    found = [_person(at, who, (people, frames), known) for who in range(people)]
    return joined(_seen(found, path))


def _seen(found: list[Found], path: Path) -> list[Found]:
    """Tracks by their numbers, in the frames where they were seen, as track_info.json tells."""
    for folder in (path.parent, path.parent.parent):
        if (folder / "track_info.json").is_file():
            break
    else:
        return found
    at = need(read_any(folder / "track_info.json"), "tracks")
    named: list[Found] = []
    for track, one in people_of(at):
        index = int(one_number(need(one, "index")))
        mask = numbers(need(one, "vis_mask")).reshape(-1) > 0
        if not 0 <= index < len(found) or len(mask) != len(found[index].frame) or not mask.any():
            continue
        rows_seen = chosen(found[index], torch.from_numpy(mask).nonzero()[:, 0])
        who = torch.full_like(rows_seen.person, track)
        named.append(dataclasses.replace(rows_seen, person=who))
    return named or found


def _of(at: At, who: int, shape: tuple[int, int], width: int) -> Tensor:
    """The rows of one person: told for each frame and person, each frame, or each person."""
    people, frames = shape
    value = numbers(at)
    if value.size == people * frames * width:
        return tensor(value.reshape(people, frames, width)[who])
    if value.size == frames * width:
        return tensor(value.reshape(frames, width))
    if value.size not in (people * width, width):
        refuse(at, f"({people}, {frames}, {width}) numbers", f"shape {value.shape}")
    one = value.reshape(-1, width)
    return tensor(one[min(who, len(one) - 1)][None].repeat(frames, 0))


def _person(at: At, who: int, shape: tuple[int, int], known: Known) -> Found:
    def told(name: str, width: int) -> Tensor:
        return _of(need(at, name), who, shape, width)

    betas = numbers(need(at, "betas"))
    shapes = betas.size if betas.ndim < 2 else betas.shape[-1]
    whole = torch.cat([told("root_orient", 3), told("pose_body", 63)], 1)
    R, t = told("cam_R", 9).reshape(-1, 3, 3), told("cam_t", 3)
    rows = whole, told("betas", shapes), told("trans", 3)
    found = people_rows(
        known, "smplh", torch.arange(shape[1]), who, rows,
        K=_lens(at, shape[1]), up=(R @ _up(at, who)[:, None])[..., 0], warnings=movement(R, t),
    )  # fmt: skip
    return shifted(found, R, t)


def _up(at: At, who: int) -> Tensor:
    """Away from the ground, in SLAHMR's world."""
    plane = either(at, "floor_plane")
    if plane is not None:
        planes = stacked(plane, 4 if numbers(plane).shape[-1:] == (4,) else 3)[:, :3]
        normal = tensor(planes[min(who, len(planes) - 1)])
        if normal.isfinite().all() and normal.norm() > LEAST_OFFSET:
            normal = normal / normal.norm()
            return -normal if normal[1] > 0 else normal
    return torch.tensor(UP)


def _lens(at: At, frames: int) -> Tensor | None:
    given = either(at, "intrins")
    if given is None:
        return None
    fx, fy, cx, cy = stacked(given, 4)[0].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).expand(frames, 3, 3)
