"""Pickles of other programs, read as data by an allow list of names: nothing in them ever runs.

Python's own unpickler reads the opcodes; those that import, call or set are refused. What a file
names is a word (`Word`), and what it would call is kept as data (`Call`). Only then is each call of
the list worked out, by functions of this module. Torch files are read by torch's reader of weights.
"""

import bz2
import lzma
import math
import pickle
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.lib import format as npy

from mover.core.errors import InputError
from mover.core.files import unreadable
from mover.core.records import BROKEN

LARGEST = 2 << 30
"""No file and no array is larger, and no tree that a file unfolds to [bytes]."""
REPEATED = 1 << 26
"""No tensor that repeats its numbers is larger [bytes]."""
DEEPEST = 64
"""Levels of lists and mappings."""
ITEM = 64  # what Python takes for an item of a list, nearly [bytes]
TORCH = 0x1950A86A20F9469CFC6C
"""The number that old torch files start with."""
PLAIN = "expected arrays, numbers, text and containers"
READ: dict[int, Any] = pickle._Unpickler.dispatch  # pyright: ignore[reportPrivateUsage]
REFUSED = (
    pickle.INST, pickle.OBJ, pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.PERSID,
    pickle.BINPERSID, pickle.NEWOBJ_EX, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
)  # fmt: skip
"""Opcodes that would make more than data."""
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
TYPES = re.compile(r"[<>=|]?(\?|[biufcSU]\d{1,7}|[bBhHiIlLqQefdFDgG]|O8?|object)")
"""Names of types of numbers, of text and of objects; no fields."""
SETS = ("builtins.set", "builtins.frozenset")
SIMPLE = (int, float, complex, str, bytes, type(None))
RENAMED = {
    "__builtin__": "builtins", "copy_reg": "copyreg", "pathlib._local": "pathlib",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
    **{f"scipy.sparse.{dash}{form}": "scipy.sparse" for dash in ("", "_")
       for form in ("csc", "csr", "coo")},
}  # fmt: skip
"""Modules that are the same as others: of Python 2, of other versions."""


def load_plain(path: Path) -> Any:  # noqa: ANN401
    """The content of a pickle as a tree: keys as text; arrays of objects and tuples as lists.

    Understood are numbers, text, paths (text), containers, arrays of numpy, chumpy and torch (all
    as numpy's) and scipy's sparse matrices (csc, csr, coo); Python 2's text is latin1. The file may
    be joblib's (compressed or not), a torch file of tensors, or an .npy file with an object.

    Raises:
        InputError: If the file is missing, too large or broken, names any other class, holds
            itself, or unfolds to more than `LARGEST`.
    """
    name = path.name
    if not path.is_file():
        raise InputError(f"{name}: there is no such file in {path.parent}, expected a pickle")
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"has {path.stat().st_size} bytes, expected at most {LARGEST}")
        with warnings.catch_warnings():  # of storages that have types, of escapes that are none
            warnings.simplefilter("ignore")
            return _plain(_loaded(path.read_bytes()), {}, 0)[0]
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except BROKEN_PICKLE as error:
        raise unreadable(path, error, "a pickle of arrays") from error


def _loaded(data: bytes) -> Any:  # noqa: ANN401
    """The content of a file in any of the forms, with calls as data."""
    for heads, packed in PACKED.items():
        if data.startswith(heads):
            unpacker = packed()
            data = unpacker.decompress(data, LARGEST + 1)
            if len(data) > LARGEST:
                raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
            if not unpacker.eof:
                raise ValueError("it ends too early")
            break
    if data[:4] == b"PK\x03\x04":
        return _of_archive(data)
    stream = BytesIO(data)
    if data[:6] == b"\x93NUMPY":
        version = npy.read_magic(stream)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        if read(stream)[2] != np.dtype("O"):
            raise ValueError("an .npy file of plain numbers, which is no pickle")
    value = Reader(stream).load()
    return _of_torch(data) if type(value) is int and value == TORCH else value


def _of_archive(data: bytes) -> Any:  # noqa: ANN401
    """The content of a torch file that is a zip archive."""
    with zipfile.ZipFile(BytesIO(data)) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > LARGEST:
            raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
        names = archive.namelist()
        pickles = [name for name in names if name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise InputError("is a zip archive without data.pkl, expected a torch file")
        if any(name.startswith(pickles[0].removesuffix(".pkl") + "/") for name in names):
            return _of_torch(data)
        return Reader(BytesIO(archive.read(pickles[0]))).load()  # no tensors: as numpy's arrays


def _of_torch(data: bytes) -> Any:  # noqa: ANN401
    """The content of a torch file."""
    try:
        value = torch.load(BytesIO(data), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # its text names the way to run what a file holds
        named = re.search(r"GLOBAL (\S+)", str(error))
        held = f"the pickle holds {named[1][:200]}" if named else "is a broken torch file"
        raise InputError(f"{held}, expected tensors, numbers, text and containers") from error
    if isinstance(value, torch.storage.TypedStorage):
        return torch.empty(0, dtype=value.dtype).set_(value)  # pyright: ignore[reportArgumentType]
    return value


class Row(tuple[Any, ...]):
    """A tuple that is a key only if its hash is quick: of numbers and text, not of more tuples."""

    __slots__ = ()

    def __hash__(self) -> int:
        if not all(isinstance(v, SIMPLE) for v in self):
            raise ValueError("a key that is no text, number or tuple of these")
        return super().__hash__()


class Call:
    """What a pickle would call, as data: name, arguments, and the state and items that follow."""

    __slots__ = ("args", "items", "name", "state")

    def __init__(self, name: Any, args: tuple[Any, ...]) -> None:  # noqa: ANN401
        if not isinstance(name, Word):
            raise ValueError("a call of something that has no name")
        self.name, self.args, self.state = name, args, None
        self.items: dict[Any, Any] = {}

    def __setitem__(self, key: object, value: object) -> None:
        self.items[key] = value

    def __setstate__(self, state: Any) -> None:  # noqa: ANN401
        self.state = state


class Word(str):
    """A class or function that a pickle names: a word, not the thing."""

    __slots__ = ()

    def __call__(self, *args: Any) -> Call | set[Any]:  # noqa: ANN401
        """The call as data; of what is made for an object of a class, that of the class."""
        if self in SETS and all(isinstance(items, list | tuple) for items in args):
            return set(*args)  # items are hashed at once, as those of other sets
        if self == "copyreg.__newobj__":
            return Call(args[0], args[1:])
        if self != "copyreg._reconstructor":
            return Call(self, args)
        kind, base, state = args
        if not isinstance(base, Word) or not base.endswith(".object") or state is not None:
            raise ValueError("an object of another class's")
        return Call(kind, ())


class Reader(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
    """Python's reader of a pickle, without any opcode that could import, call or set."""

    stack: list[Any]

    def __init__(self, stream: BytesIO) -> None:
        super().__init__(stream, encoding="latin1")
        self.stream = stream

    def find_class(self, module: str, name: str) -> Word:
        """The word for a class or function of the list.

        Raises:
            InputError: If it is not in the list; nothing was imported or called.
        """
        full, shown = Word(f"{RENAMED.get(module, module)}.{name}"), f"{module}.{name}"
        chumpy = module.split(".")[0] == "chumpy" and name.isidentifier()
        if chumpy or full in WORDS or full in MADE:
            return full
        shown = shown if shown.isprintable() and len(shown) < 200 else "a class with an odd name"
        raise InputError(f"the pickle holds {shown}, {PLAIN}")

    def build(self) -> None:
        """BUILD: the state of a call; behind that of joblib lies an array."""
        READ[pickle.BUILD[0]](self)
        call = self.stack[-1]
        if not isinstance(call, Call):
            raise ValueError("a state for something that has none")
        if call.name == JOBLIB:
            form, stream = _plain(call.state, {}, 0)[0], self.stream
            if form["dtype"].hasobject:
                call.state = Reader(stream).load()
                return
            if form.get("numpy_array_alignment_bytes") is not None:
                stream.read(stream.read(1)[0])
            raw = stream.read(math.prod(form["shape"]) * form["dtype"].itemsize)
            call.state = _filled(raw, form["dtype"], form["shape"], form["order"])

    def row(self, code: int) -> None:
        """TUPLE and its like: as a row."""
        READ[code](self)
        self.stack[-1] = Row(self.stack[-1])

    dispatch: ClassVar[dict[int, Any]] = dict[int, Any](
        {code: act for code, act in READ.items() if bytes([code]) not in REFUSED}
        | {code: lambda reader, code=code: reader.row(code) for code in b"t\x85\x86\x87"}
        | {
            pickle.NEWOBJ[0]: READ[pickle.REDUCE[0]], pickle.BUILD[0]: build,
            pickle.BYTEARRAY8[0]: READ[pickle.BINBYTES8[0]],
        }
    )  # fmt: skip


def _plain(value: Any, done: dict[int, Any], depth: int) -> tuple[Any, int]:  # noqa: ANN401
    """A value as a tree with each call worked out, and its bytes if all that it shares is written.

    `done` has what was found for each thing by its id, with the thing, which so keeps its id.
    """
    if not isinstance(value, Call | Mapping | list | tuple | set | frozenset):
        value = _array_of(value) if isinstance(value, torch.Tensor) else value
        letters = 4 * len(value) if isinstance(value, str | bytes) else 0
        return value, ITEM + letters + int(getattr(value, "nbytes", 0))
    if id(value) not in done:
        if depth >= DEEPEST:
            raise InputError(f"holds lists in lists in more than {DEEPEST} levels, expected fewer")
        done[id(value)] = value, None
        inside: Any = value.values() if isinstance(value, Mapping) else value
        if isinstance(value, Call):
            inside = value.args, value.state, value.items
        found = [_plain(item, done, depth + 1) for item in inside]
        plain, size = [item for item, _ in found], ITEM + sum(size for _, size in found)
        if isinstance(value, Call):
            plain = MADE.get(value.name, _chumpy)(value.name, *plain)
            size = size if isinstance(plain, list | dict) else ITEM + getattr(plain, "nbytes", 0)
        elif isinstance(value, Mapping):
            keys = (_plain(k, done, depth)[0] if isinstance(k, Call) else k for k in value)
            plain = dict(zip(map(str, keys), plain, strict=True))
        elif isinstance(value, set | frozenset):
            plain = set(plain)
        if size > LARGEST:
            raise InputError(f"unfolds to more than {LARGEST} bytes, expected at most that")
        done[id(value)] = value, (plain, size)
    if done[id(value)][1] is None:
        raise InputError("holds a list that contains itself, expected a tree")
    return done[id(value)][1]


# What the calls of the list describe: each takes its name, arguments, state and items.


def _array_of(tensor: torch.Tensor) -> np.ndarray:
    """A tensor's numbers; those of bfloat16 as floats."""
    held = tensor.untyped_storage().nbytes()
    if tensor.numel() * tensor.element_size() > max(held, REPEATED):
        raise ValueError("a tensor that is larger than what it holds")
    plain = tensor.detach()
    return (plain.float() if plain.dtype == torch.bfloat16 else plain).numpy()


def _tensor(_: str, args: list[Any], *__: object) -> np.ndarray:
    """A tensor in a pickle of Python: a view of its storage."""
    storage, offset, size, stride = args[:4]
    try:
        return _array_of(torch.from_numpy(storage).as_strided(size, stride, offset))
    except TypeError as error:
        raise ValueError("a tensor with an odd shape") from error
    except RuntimeError as error:
        raise ValueError("a tensor that is larger than what it holds") from error


def _bytes(_: str, args: list[Any], *__: object) -> bytes:
    """Bytes from text or bytes, never from a size."""
    raw, coding = [*args, *(b"", "latin1")[len(args) :]]
    if not isinstance(raw, str | bytes | list) or coding not in ("latin1", "latin-1"):
        raise ValueError("bytes from something else than text")
    return raw.encode("latin1") if isinstance(raw, str) else bytes(raw)


def _list(_: str, args: list[Any], *__: object) -> list[Any]:
    """The items of another container."""
    if args and not isinstance(args[0], list):
        raise ValueError("a container of something else than a list")
    return args[0] if args else []


def _mapping(name: str, args: list[Any], _: object, items: dict[str, Any]) -> dict[str, Any]:
    """Of a mapping with a maker of defaults, that is not kept."""
    pairs = args[0] if args and not name.endswith("defaultdict") else []
    return {str(key): value for key, value in dict(pairs).items()} | items


def _dtype(_: str, args: list[Any], state: Any, __: object) -> np.dtype[Any]:  # noqa: ANN401
    if not isinstance(args[0], str) or not TYPES.fullmatch(args[0]):
        raise ValueError("a type of something else than numbers and text")
    found = np.dtype(args[0])
    if isinstance(state, list) and len(state) > 4:
        if any(x is not None for x in state[2:5]):
            raise ValueError("a type with fields")
        if state[1] in ("<", ">"):
            found = found.newbyteorder(state[1])
    return found


def _filled(raw: Any, dtype: Any, shape: Any, order: Any) -> Any:  # noqa: ANN401
    """The array of these bytes, or the nested list of these objects, as many as the shape says."""
    whole = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not isinstance(dtype, np.dtype) or not whole or len(shape) > 32:
        raise ValueError("an array without type, or with an odd shape")
    count = math.prod(shape)
    if dtype.hasobject:
        if not isinstance(raw, list) or len(raw) != count:
            raise ValueError("an array with the wrong number of objects")
        return np.fromiter(raw, object, count).reshape(shape, order=order).tolist()
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(data, bytes) or len(data) != count * dtype.itemsize:
        raise ValueError("an array whose bytes do not fit its shape")
    if not count or not dtype.itemsize:
        return np.zeros((0,) if not dtype.itemsize else shape, dtype)
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order=order)


def _array(_: str, args: list[Any], state: Any, __: object) -> Any:  # noqa: ANN401
    if args[0] not in ("numpy.ndarray", "numpy.memmap") or not isinstance(state, list):
        raise ValueError("an array without content")
    shape, dtype, fortran, raw = state[-4:]
    return _filled(raw, dtype, shape, "F" if fortran else "C")


def _sparse(name: str, _: object, state: Any, __: object) -> Any:  # noqa: ANN401
    """A scipy matrix from its arrays, whose indices scipy checks."""
    from scipy import sparse

    form = name.rpartition(".")[2][:3]
    parts = ("row", "col") if form == "coo" else ("indices", "indptr")
    arrays = [state["data"], *(state.get("coords") or [state[part] for part in parts])]
    shape = state.get("_shape", state.get("shape"))
    if not all(isinstance(a, np.ndarray) and a.ndim == 1 for a in arrays) or len(shape) != 2:
        raise ValueError("a sparse matrix without its arrays")
    if form == "coo":
        return sparse.coo_matrix((arrays[0], (arrays[1], arrays[2])), shape=shape)
    kind = sparse.csc_matrix if form == "csc" else sparse.csr_matrix
    matrix = kind(tuple(arrays), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def _chumpy(name: str, _: object, state: Any, __: object) -> np.ndarray:  # noqa: ANN401
    """The array in an object of chumpy: its value, or a selection, a new shape of another's."""
    match state:
        case {"x": np.ndarray() as value}:
            return value
        case {"a": np.ndarray() as base, "idxs": np.ndarray() as chosen, "preferred_shape": shape}:
            return base.ravel()[chosen].reshape(shape)
        case {"a": np.ndarray() as base, "newshape": shape}:
            return base.reshape(shape)
        case _:
            raise InputError(f"the pickle holds {name} without an array, expected its values")


JOBLIB = "joblib.numpy_pickle.NumpyArrayWrapper"
WORDS = {
    "copyreg._reconstructor", "copyreg.__newobj__", "numpy.ndarray", "numpy.memmap", "torch.bool",
    "torch.bfloat16", *(f"builtins.{name}" for name in ("object", "int", "float", "str", "bool")),
    *(f"{module}.{kind}{bits}" for module in ("numpy", "torch") for kind, sizes in
      (("float", (16, 32, 64)), ("int", (8, 16, 32, 64)), ("uint", (8,))) for bits in sizes),
}  # fmt: skip
"""What a pickle may name, but not call; but for copyreg's two, see `Word`."""
MADE: Mapping[str, Callable[..., Any]] = {
    **dict.fromkeys((*SETS, "builtins.list", "builtins.tuple", "torch.Size"), _list),
    **dict.fromkeys(
        ("builtins.dict", "collections.OrderedDict", "collections.defaultdict"), _mapping
    ),
    **dict.fromkeys(("builtins.bytes", "builtins.bytearray", "_codecs.encode"), _bytes),
    "builtins.complex": lambda _, args, *__: complex(*args),
    **dict.fromkeys(
        (f"pathlib.{name}Path" for name in ("Posix", "PurePosix", "Windows", "PureWindows")),
        lambda _, args, *__: "/".join(args).replace("//", "/"),
    ),
    "numpy.dtype": _dtype,
    "numpy.core.multiarray._reconstruct": _array,
    "numpy.core.multiarray.scalar": lambda _, args, *__: _filled(args[1], args[0], [1], "C")[0],
    "numpy.core.numeric._frombuffer": lambda _, args, *__: _filled(*args),
    **{f"scipy.sparse.{form}_{kind}": _sparse for form in ("csc", "csr", "coo")
       for kind in ("matrix", "array")},
    JOBLIB: lambda *parts: parts[2],  # the reader put the array there
    **dict.fromkeys(
        ("torch.device", "torch._utils._rebuild_parameter"), lambda _, args, *__: args[0]
    ),
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch.storage._load_from_bytes": lambda _, args, *__: _plain(_of_torch(args[0]), {}, 0)[0],
}  # fmt: skip
"""What a pickle may call: worked out by functions that are all written here."""
