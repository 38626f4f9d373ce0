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
from mover.core.files import replacing
from mover.core.records import BROKEN
from mover.io.files.fields import LARGEST_FILE, At, reason


def read_npz(path: Path, *, without_objects: bool = False) -> At:
    """The arrays of an .npz file by name.

    Args:
        path: The file.
        without_objects: Leave arrays of pickled objects out instead of refusing the file.

    Raises:
        InputError: If it is missing, broken, too large, or holds pickled objects.
    """
    name = path.name
    if not path.is_file():
        raise InputError(f"{name}: there is no such file in {path.parent}, expected an .npz file")
    try:
        kept = _checked_headers(path, without_objects)
        with np.load(path, allow_pickle=False) as arrays:
            return At({key: arrays[key] for key in arrays.files if key in kept}, name)
    except BROKEN as error:
        raise InputError(
            f"{name}: cannot be read ({reason(error)}), expected an .npz file"
        ) from error


def _checked_headers(path: Path, without_objects: bool) -> set[str]:
    """Names of the arrays, whose promised sizes and types are checked before any is unpacked."""
    total, kept = 0, set[str]()
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            with archive.open(entry) as stream:
                dtype, size = _header(stream)
            total += size
            key = entry.filename.removesuffix(".npy")
            if dtype.hasobject and without_objects:
                continue
            kept.add(key)
            if dtype.hasobject or dtype.fields:
                found = f"has {dtype}, expected plain numbers or text (no pickled objects)"
                raise InputError(f"{path.name}: field '{key}' {found}")
            if total > LARGEST_FILE:
                found = f"has {total} bytes or more, expected at most {LARGEST_FILE} in the file"
                raise InputError(f"{path.name}: field '{key}' {found}")
    return kept


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
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected an .npy file"
        ) from error


def write_npz(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write arrays in one step, always the same bytes for the same arrays."""
    with replacing(path) as part:
        np.savez(part, allow_pickle=False, **dict(arrays))
