"""Readers: a format is a file and a row in `READERS`; every reader gives a Capture."""

from collections.abc import Callable
from pathlib import Path

from ..types import Capture
from .arrays import ObjectArrays, PeopleArrays, capture_from_arrays
from .folder import read_capture, write_capture
from .total3d import read_total3d

__all__ = [
    "READERS", "ObjectArrays", "PeopleArrays", "capture_from_arrays", "read", "read_capture",
    "write_capture",
]  # fmt: skip

READERS: dict[str, Callable[[Path], Capture]] = {"folder": read_capture, "total3d": read_total3d}
"""How to read each format, by name."""


def read(format: str, path: Path) -> Capture:
    """Read a capture.

    Args:
        format: A name in `READERS`.
        path: The file or folder.

    Raises:
        ValueError: If there is no such format.
        InputError: If the data is wrong.
    """
    if format not in READERS:
        raise ValueError(f"format is {format!r}, choose one of {', '.join(sorted(READERS))}")
    return READERS[format](Path(path))
