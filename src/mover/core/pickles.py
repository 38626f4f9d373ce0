"""Pickles of other programs, read as data: nothing that a file names is ever imported or called.

The reader of the standard library (the one in Python) reads the opcodes of data; the others are
refused. A class or function is a word of a short list, see `pickle_parts`.
"""

import bz2
import lzma
import math
import pickle
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from mover.core.errors import InputError
from mover.core.pickle_parts import (
    CONTENT,
    JOBLIB,
    TORCH_BYTES,
    Name,
    Part,
    Row,
    chumpy_array,
    filled,
    made,
    named,
    storage_of,
    storage_type,
)
from mover.core.records import BROKEN

LARGEST = 2 << 30
"""No file and no array is larger [bytes]."""
DEEPEST = 64
"""Levels of lists and mappings in a plain value."""
ITEM = 64  # what Python takes for an item of a list, nearly [bytes]
TORCH = 0x1950A86A20F9469CFC6C
"""The number that old torch files start with."""
READ: dict[int, Any] = pickle._Unpickler.dispatch  # pyright: ignore[reportPrivateUsage]
REFUSED = (
    pickle.INST, pickle.OBJ, pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.PERSID,
    pickle.NEWOBJ_EX, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
)  # fmt: skip
"""Opcodes that would make more than data."""
TUPLES = (pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3)
BROKEN_PICKLE = (
    *BROKEN, OverflowError, AssertionError, struct.error, lzma.LZMAError, pickle.UnpicklingError,
)  # fmt: skip
PACKED: Mapping[tuple[bytes, ...], Callable[[], Any]] = {
    (b"\x1f\x8b", b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda"): (
        lambda: zlib.decompressobj(wbits=47)
    ),
    (b"BZh",): bz2.BZ2Decompressor,
    (b"\xfd7zXZ\x00", b"\x5d\x00"): lzma.LZMADecompressor,
}
"""How files with these first bytes are unpacked: gzip and zlib, bzip2, xz and lzma."""


# Files: plain, compressed, joblib's, torch's, or inside an .npy file.


def load_pickle(path: Path) -> Any:  # noqa: ANN401
    """The content of a pickle, as data: nothing in it is imported or called.

    Understood are numbers, text, containers, numpy arrays, scipy's sparse matrices (csc, csr, coo),
    chumpy arrays and torch tensors (both become numpy arrays), paths (text); Python 2's text is
    read as latin1. The file may be a pickle, one of joblib (compressed or not), a torch file, or an
    .npy file with an object. What is shared in the file is shared here, so that a list may hold
    itself: whoever walks through takes `load_plain`.

    Raises:
        InputError: If the file is missing, too large, broken, or names any other class.
    """
    return _read(path, lambda value: value)


def load_plain(path: Path) -> Any:  # noqa: ANN401
    """The content of a pickle as a tree: keys as text, arrays of objects and tuples as lists.

    Raises:
        InputError: As `load_pickle`; also if it holds itself, or unfolds to more than `LARGEST`.
    """
    return _read(path, lambda value: _unfolded(value, {}, 0)[0])


def _read(path: Path, finished: Callable[[Any], Any]) -> Any:  # noqa: ANN401
    name = path.name
    if not path.is_file():
        raise InputError(f"{name}: there is no such file in {path.parent}, expected a pickle")
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"has {path.stat().st_size} bytes, expected at most {LARGEST}")
        return finished(_loaded(path.read_bytes()))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except BROKEN_PICKLE as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{name}: cannot be read ({why}), expected a pickle of arrays") from error


def _loaded(data: bytes) -> Any:  # noqa: ANN401
    """The content of a file in any of the forms."""
    if data[:4] == b"PK\x03\x04":
        return _archive(data)
    for heads, packed in PACKED.items():
        if data.startswith(heads):
            data = _unpacked(data, packed())
            break
    stream = BytesIO(data)
    if data[:6] == b"\x93NUMPY":
        version = npy.read_magic(stream)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        if read(stream)[2] != np.dtype("O"):
            raise ValueError("an .npy file of plain numbers, which is no pickle")
    value = Reader(stream).load()
    return _old_torch(stream) if type(value) is int and value == TORCH else value


def _unpacked(data: bytes, packed: Any) -> bytes:  # noqa: ANN401
    """The bytes without compression, never more than `LARGEST`.

    Raises:
        InputError: If they would be more.
    """
    result = packed.decompress(data, LARGEST + 1)
    if len(result) > LARGEST:
        raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
    if not packed.eof:
        raise ValueError("it ends too early")
    return result


def _archive(data: bytes) -> Any:  # noqa: ANN401
    """A torch file of the form since 1.6: a zip archive."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
            raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
        names = [n for n in archive.namelist() if n.endswith("/data.pkl")]
        if len(names) != 1:
            raise InputError("is a zip archive without data.pkl, expected a torch file")
        root = names[0].removesuffix("data.pkl")
        stream = BytesIO(archive.read(names[0]))
        return Reader(stream, lambda key: archive.read(f"{root}data/{key}")).load()


def _old_torch(stream: BytesIO) -> Any:  # noqa: ANN401
    """A torch file of the form before 1.6, behind its first number: numbers follow the pickle."""
    Reader(stream).load()  # version
    Reader(stream).load()  # sizes of types
    reader = Reader(stream)
    value = reader.load()
    for key in Reader(stream).load():
        kind, array = reader.storages[str(key)]
        (count,) = struct.unpack("<q", stream.read(8))
        raw = stream.read(count * storage_type(kind).itemsize)
        if count != len(array):
            raise ValueError("it ends too early")
        array[:] = storage_of(kind, raw)
    return value


# Opcodes.


class Memo(dict[int, Any]):
    """What a pickle may refer to again; parts know where they are, to be replaced when whole."""

    def __setitem__(self, place: int, value: object) -> None:
        if isinstance(value, Part):
            value.places.append(place)
        super().__setitem__(place, value)


class Opcodes(dict[int, Callable[[Any], None]]):
    """What each opcode does; INST, OBJ, EXT and the like are not there."""

    def __missing__(self, code: int) -> Callable[[Any], None]:
        raise ValueError(f"opcode {code:#04x}")


def _as_row(code: int) -> Callable[[Any], None]:
    """What an opcode of a tuple does."""

    def act(reader: Any) -> None:  # noqa: ANN401
        READ[code](reader)
        reader.append(Row(reader.stack.pop()))

    return act


class Reader(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
    """Python's reader of a pickle, without any opcode that could import, call or set."""

    stack: list[Any]
    memo: dict[int, Any]
    append: Callable[[Any], None]

    def __init__(self, stream: BytesIO, stored: Callable[[str], bytes] | None = None) -> None:
        """Args: stream: Of one pickle. stored: The bytes of torch's storages, if not behind it."""
        super().__init__(stream, encoding="latin1")
        self.memo = Memo()
        self.stream, self.stored = stream, stored
        self.storages: dict[str, tuple[str, np.ndarray]] = {}
        self.left = stream.getbuffer().nbytes
        """Bytes that storages behind the pickle may still have."""

    def load(self) -> Any:  # noqa: ANN401
        """The value of one pickle."""
        with warnings.catch_warnings():  # of escapes that are none, in texts that are broken
            warnings.simplefilter("ignore", DeprecationWarning)
            return super().load()

    def find_class(self, module: str, name: str) -> Name:
        """A word, where Python's reader would import."""
        return named(module, name)

    def persistent_load(self, pid: Any) -> np.ndarray:  # noqa: ANN401
        """The numbers of a storage of torch; zeros where they follow later.

        Raises:
            ValueError: If it is none, or larger than the file.
        """
        match pid:
            case ("storage", Name() as kind, key, _, int() as count, *_) if count >= 0:
                key = str(key)
            case _:
                raise ValueError("a reference to something outside")
        if key not in self.storages:
            size = count * storage_type(kind).itemsize
            self.left -= 0 if self.stored else size
            if self.left < 0:
                raise ValueError("it ends too early")
            self.storages[key] = (
                kind,
                storage_of(kind, self.stored(key) if self.stored else bytes(size)),
            )
        return self.storages[key][1]

    def make(self) -> None:
        """REDUCE and NEWOBJ: what a call would make."""
        args, name = self.stack.pop(), self.stack.pop()
        self.append(_storage(*args) if name == TORCH_BYTES else made(name, args))

    def build(self) -> None:
        """BUILD: the content of a part, which becomes whole everywhere."""
        state, part = self.stack.pop(), self.stack[-1]
        if isinstance(part, dict):  # attributes of an OrderedDict
            return
        if not isinstance(part, Part):
            raise ValueError("a state for something that has none")
        if part.name == JOBLIB:
            value = self._array_behind(state)
        else:
            value = (CONTENT.get(part.name) or chumpy_array)(part, state)
        self.stack[-1] = value
        for place in part.places:
            self.memo[place] = value

    def _array_behind(self, form: Any) -> Any:  # noqa: ANN401
        """The array that joblib wrote behind its description.

        Raises:
            ValueError: If the description is odd or the bytes are not there.
        """
        dtype, shape, stream = form["dtype"], form["shape"], self.stream
        if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple):
            raise ValueError("an array without type or shape")
        if dtype.hasobject:
            return Reader(stream).load()
        if form.get("numpy_array_alignment_bytes") is not None:
            stream.read(stream.read(1)[0])
        return filled(stream.read(math.prod(shape) * dtype.itemsize), dtype, shape, form["order"])

    dispatch = Opcodes(
        {code: act for code, act in READ.items() if bytes([code]) not in REFUSED}
        | {code[0]: _as_row(code[0]) for code in TUPLES}
        | {
            pickle.REDUCE[0]: make, pickle.NEWOBJ[0]: make, pickle.BUILD[0]: build,
            pickle.BYTEARRAY8[0]: READ[pickle.BINBYTES8[0]],
        }
    )  # fmt: skip


def _storage(data: bytes) -> np.ndarray:
    """A storage of torch that was pickled by itself.

    Raises:
        ValueError: If it is none.
    """
    stream = BytesIO(data)
    if Reader(stream).load() != TORCH:
        raise ValueError("a storage that is none of torch")
    found = _old_torch(stream)
    if not isinstance(found, np.ndarray):
        raise ValueError("a storage without numbers")
    return found


# Trees.


def _unfolded(value: Any, done: dict[int, Any], depth: int) -> tuple[Any, int]:  # noqa: ANN401
    """A value as a tree, and the bytes that it would take if all that it shares were written out.

    Args:
        value: What a pickle holds.
        done: What was found for each thing by its id, with the thing, which so keeps its id.
        depth: Levels above it.

    Raises:
        InputError: If it holds itself, is too deep or too large.
    """
    if isinstance(value, str | bytes):
        return value, ITEM + 4 * len(value)
    objects = isinstance(value, np.ndarray) and value.dtype == object
    if not objects and not isinstance(value, Mapping | list | tuple):
        return value, ITEM + int(getattr(value, "nbytes", 0))
    if id(value) not in done:
        if depth >= DEEPEST:
            raise InputError(f"holds lists in lists in more than {DEEPEST} levels, expected fewer")
        done[id(value)] = value, None
        items = value.values() if isinstance(value, Mapping) else value
        inner = [value.tolist()] if isinstance(value, np.ndarray) else items
        found = [_unfolded(item, done, depth + 1) for item in inner]
        size = ITEM + sum(size for _, size in found)
        if size > LARGEST:
            raise InputError(f"unfolds to more than {LARGEST} bytes, expected at most that")
        plain: Any = [item for item, _ in found]
        if isinstance(value, Mapping):
            plain = dict(zip(map(str, value), plain, strict=True))
        done[id(value)] = value, (plain[0] if objects else plain, size)
    if done[id(value)][1] is None:
        raise InputError("holds a list that contains itself, expected a tree")
    return done[id(value)][1]
