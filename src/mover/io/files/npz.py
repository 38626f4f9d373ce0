"""Read and write .npz files that others made: no pickles, no bombs, the same bytes each time."""

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.files import replacing, unreadable
from mover.core.records import BROKEN
from mover.io.files.fields import LARGEST_FILE, At, existing


class NotPlain:
    """Stands for an array of Python's objects or of fields, which is refused where it is needed."""

    def __repr__(self) -> str:
        return "no plain numbers (no pickled objects are read)"


AMASS = (
    "a motion of AMASS, in a world of its own and not in a camera: --bodies-from amass, or `mover "
    "import-bodies amass`, reads it upright, but where people are in the picture it does not say"
)


def is_amass(at: At) -> bool:
    """Whether these are the arrays of a motion."""
    keys = at.mapping().keys()
    return "trans" in keys and "frame" not in keys and not keys.isdisjoint(("poses", "pose_body"))


def read_npz(path: Path) -> At:
    """The arrays of an .npz file by name; one of objects or fields is `NotPlain`."""
    name = existing(path, "an .npz file").name or path.resolve().name
    try:
        odd = _odd_arrays(path)
        with np.load(path, allow_pickle=False) as arrays:
            return At({key: odd.get(key) or arrays[key] for key in arrays.files}, name)
    except BROKEN as error:
        raise unreadable(path, error, "an .npz file") from error


def _odd_arrays(path: Path) -> dict[str, NotPlain]:
    """Arrays that are not plain; sizes that are promised are checked before any is unpacked."""
    total, odd = 0, dict[str, NotPlain]()
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as stream:
                dtype, size = _header(stream)
            total += size
            key = entry.filename.removesuffix(".npy")
            if dtype.hasobject or dtype.fields:
                odd[key] = NotPlain()
            if total > LARGEST_FILE:
                found = f"has {total} bytes or more, expected at most {LARGEST_FILE} in the file"
                raise InputError(f"{path.name}: field '{key}' {found}")
    return odd


def _header(stream: Any) -> tuple[np.dtype[Any], int]:  # noqa: ANN401
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(stream)
    if version not in read:
        raise ValueError(f"version {version} of the .npy format")
    shape, _, dtype = read[version](stream)
    if any(n < 0 for n in shape):
        raise ValueError(f"an array of shape {shape}")
    return dtype, dtype.itemsize * math.prod(shape)


def read_npy(path: Path) -> At:
    """The array of an .npy file.

    Raises:
        InputError: If it is missing, broken, promises more than it has or holds pickled objects.
    """
    if not path.is_file():
        raise InputError(f"{path.name}: there is no such regular file in {path.parent}")
    try:
        with path.open("rb") as file:
            dtype, size = _header(file)
            if dtype.hasobject or dtype.fields:
                found = f"has {dtype}, expected plain numbers (no pickled objects)"
                raise InputError(f"{path.name}: {found}")
            if size > min(LARGEST_FILE, path.stat().st_size):
                found = f"promises {size} bytes, expected no more than it has"
                raise InputError(f"{path.name}: {found}")
            file.seek(0)
            return At(np.load(file, allow_pickle=False), path.name)
    except BROKEN as error:
        raise unreadable(path, error, "an .npy file") from error


def write_npz(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write arrays in one step, always the same bytes for the same arrays."""
    with replacing(path) as part:
        np.savez(part, allow_pickle=False, **dict(arrays))
