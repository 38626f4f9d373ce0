"""Reads a pickle from a file: plain, compressed, joblib's, torch's, or inside an .npy file."""

import bz2
import lzma
import pickle
import struct
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from ..records import BROKEN, InputError
from .arrays import LARGEST
from .machine import Machine
from .parts import STORAGES
from .values import Settler

TORCH = 0x1950A86A20F9469CFC6C
"""The number that old torch files start with."""
BROKEN_PICKLE = (
    *BROKEN, TypeError, AttributeError, OverflowError, AssertionError, struct.error,
    lzma.LZMAError, pickle.UnpicklingError,
)  # fmt: skip


def load_pickle(path: Path) -> object:
    """The content of a pickle, as data: nothing in it is imported or called.

    Understood are numbers, text, containers, numpy arrays, scipy's sparse matrices (csc, csr, coo),
    chumpy arrays and torch tensors (both become numpy arrays), paths (text); Python 2's text is
    read as latin1. The file may be a pickle, one of joblib (compressed or not), a torch file, or an
    .npy file with an object.

    Raises:
        InputError: If the file is missing, too large, broken, or names any other class.
    """
    name = path.name
    if not path.is_file():
        raise InputError(f"{name}: there is no such file in {path.parent}, expected a pickle")
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"has {path.stat().st_size} bytes, expected at most {LARGEST}")
        return _loaded(path.read_bytes())
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except BROKEN_PICKLE as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{name}: cannot be read ({why}), expected a pickle of arrays") from error


def _loaded(data: bytes) -> Any:  # noqa: ANN401
    """The content of a file in any of the forms."""
    if data[:4] == b"PK\x03\x04":
        return _archive(data)
    plain = _unpacked(data)
    stream = BytesIO(plain)
    if plain[:6] == b"\x93NUMPY":
        _skip_header(stream)
    machine = Machine(stream)
    tree = machine.run()
    if tree == TORCH:
        return _old_torch(stream)
    return Settler({}).settle(tree)


def _unpacked(data: bytes) -> bytes:
    """The bytes without compression, never more than `LARGEST`.

    Raises:
        InputError: If they would be more.
    """
    if data[:2] == b"\x1f\x8b":
        packed: Any = zlib.decompressobj(wbits=31)
    elif data[:1] == b"\x78" and len(data) > 1 and (data[0] * 256 + data[1]) % 31 == 0:
        packed = zlib.decompressobj()
    elif data[:3] == b"BZh":
        packed = bz2.BZ2Decompressor()
    elif data[:6] == b"\xfd7zXZ\x00" or data[:2] == b"\x5d\x00":
        packed = lzma.LZMADecompressor()
    else:
        return data
    result = packed.decompress(data, LARGEST + 1)
    if len(result) > LARGEST:
        raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
    if not packed.eof:
        raise ValueError("it ends too early")
    return result


def _skip_header(stream: BytesIO) -> None:
    """Stand behind the header of an .npy file that holds an object."""
    version = npy.read_magic(stream)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    _, _, dtype = read(stream)
    if dtype != np.dtype("O"):
        raise ValueError("an .npy file of plain numbers, which is no pickle")


def _old_torch(stream: BytesIO) -> Any:  # noqa: ANN401
    """A torch file of the form before 1.6, behind its first number."""
    Machine(stream).run()  # version
    Machine(stream).run()  # sizes of types
    machine = Machine(stream)
    tree = machine.run()
    stored: dict[str, bytes] = {}
    for key in Machine(stream).run():
        (count,) = struct.unpack("<q", stream.read(8))
        kind = machine.storages[str(key)].name.full
        name = kind.removeprefix("torch.").removesuffix("Storage")
        size = count * np.dtype(STORAGES[name]).itemsize
        stored[str(key)] = stream.read(size)
        if count < 0 or len(stored[str(key)]) != size:
            raise ValueError("it ends too early")
    return Settler(stored).settle(tree)


def _archive(data: bytes) -> Any:  # noqa: ANN401
    """A torch file of the form since 1.6: a zip archive."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
            raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
        names = [n for n in archive.namelist() if n.endswith("/data.pkl")]
        if len(names) != 1:
            raise InputError("is a zip archive without data.pkl, expected a torch file")
        root = names[0].removesuffix("data.pkl")
        machine = Machine(BytesIO(archive.read(names[0])))
        tree = machine.run()
        stored = {key: archive.read(f"{root}data/{key}") for key in machine.storages}
    return Settler(stored).settle(tree)


def storage_of(data: bytes) -> np.ndarray:
    """The numbers of a torch storage that was pickled by itself.

    Raises:
        ValueError: If it is none.
    """
    stream = BytesIO(data)
    if Machine(stream).run() != TORCH:
        raise ValueError("a storage that is none of torch")
    found = _old_torch(stream)
    if not isinstance(found, np.ndarray):
        raise ValueError("a storage without numbers")
    return found
