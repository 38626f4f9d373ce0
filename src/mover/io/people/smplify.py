"""SMPLify-X, PROX and MOVER's fits: SMPL-X parameters in pickles, by frame or for a whole video.

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
from mover.io.people.found import Found, Known, joined, people_rows, shifted
from mover.io.people.lens import assumed_lens
from mover.io.people.values import (
    either,
    files_of,
    frame_numbers,
    need,
    read_any,
    rows,
    tensor,
    wide,
)

FOCAL = 5000.0  # [px], SMPLify-X's default
CODE = 32  # numbers of a VPoser code
EXTRA = ("left_hand_pose", "right_hand_pose", "jaw_pose", "expression")
GENDERS = ("neutral", "female", "male")


def read_smplifyx(path: Path, known: Known) -> Found:
    """Fits of SMPLify-X: results/<frame>/<person>.pkl, or one such file.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    return _read(path, known, assumed=True)


def read_prox(path: Path, known: Known) -> Found:
    """Fits of PROX: results/<frame>/000.pkl, under the true lens.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    return _read(path, known, assumed=False)


def read_mover(path: Path, known: Known) -> Found:
    """Fits of the authors' MOVER: 001_all.pkl of a video, or a file a frame.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
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
