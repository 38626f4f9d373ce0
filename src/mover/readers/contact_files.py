"""Contacts of every vertex from files of other tools (POSA's, DECO's): one file, or one a frame."""

import re
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..records import BROKEN, InputError
from ..types import Bodies
from .fields import At
from .npz_file import check_array_header, read_npz

KEYS = ("probability", "contact", "contacts", "contact_label_smplx", "contact_label", "prob")
"""Names under which contacts are looked for in .npz files, the first that is there counts."""


def read_contacts(source: Path, bodies: Bodies, first: int = 0) -> Float[Tensor, "bodies verts"]:
    """Chance of touching for each vertex of these bodies, in [0, 1].

    Args:
        source: An array (bodies, vertices) or, of one body, (vertices,) in an .npy or .npz file; or
            a folder with one such file for each frame, whose names begin with the frame's number.
        bodies: Whose vertices these are.
        first: The number in the name of the first frame's file.

    Raises:
        InputError: If a file is missing or has other rows or vertices.
    """
    if not source.is_dir():
        return _checked(_array(source), source, bodies)
    files = sorted(p for p in source.iterdir() if p.suffix in (".npy", ".npz"))
    by_frame = {number - first: p for p in files if (number := _number(p)) is not None}
    missing = sorted(set(bodies.frame.tolist()) - set(by_frame))
    if missing:
        raise InputError(f"{source}: has no file for frame {missing[0]}, expected an .npy or .npz")
    if len(set(bodies.frame.tolist())) < len(bodies.frame):
        raise InputError(f"{source}: one file a frame, but the bodies have several people a frame")
    rows = [_array(by_frame[k]) for k in bodies.frame.tolist()]
    return _checked(np.concatenate([r.reshape(1, -1) for r in rows]), source, bodies)


def _number(path: Path) -> int | None:
    found = re.match(r"\D*(\d+)", path.stem)
    return int(found.group(1)) if found else None


def _array(path: Path) -> np.ndarray:
    """The contacts of a file, as numbers."""
    if path.suffix == ".npz":
        at: At = read_npz(path)
        key = next((k for k in KEYS if k in at.value), None)
        if key is None:
            raise InputError(f"{path.name}: has {sorted(at.value)}, expected one of {list(KEYS)}")
        return np.asarray(at.value[key])
    if not path.is_file():
        raise InputError(f"{path}: there is no such file, expected an .npy or .npz file")
    try:
        check_array_header(path)
        return np.asarray(np.load(path, allow_pickle=False))
    except BROKEN as error:
        raise InputError(f"{path.name}: cannot be read ({error})") from error


def _checked(value: np.ndarray, source: Path, bodies: Bodies) -> Float[Tensor, "bodies verts"]:
    rows, verts = bodies.verts.shape[:2]
    if value.dtype.kind not in "biuf" or value.size != rows * verts:
        raise InputError(
            f"{source.name}: has {value.dtype} of shape {value.shape}, expected "
            f"numbers of shape ({rows}, {verts})"
        )
    chance = torch.from_numpy(value.reshape(rows, verts).astype(np.float32))
    if not bool(chance.isfinite().all()):
        raise InputError(f"{source.name}: has values that are not finite, expected chances")
    return chance.clamp(0, 1)
