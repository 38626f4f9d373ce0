"""Pickles of other programs, read as data by an allow list of names: nothing in them ever runs.

Python's own unpickler reads the opcodes, but those that import, call or set. What a file names is a
word (`Word`), and what it would call is kept as data (`Call`). Only then is each call of the list
worked out, by functions of this module. Torch files are read by torch's reader of weights.
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

from mover.core.errors import InputError
from mover.core.files import BROKEN, not_there, unreadable

LARGEST = 2 << 30  # of a file, of an array, of the tree that a file unfolds to [bytes]
REPEATED = 1 << 26  # of a tensor that repeats its numbers [bytes]
DEEPEST = 64  # levels of lists and mappings
ITEM = 64  # what Python takes for an item of a list, nearly [bytes]
TORCH = 0x1950A86A20F9469CFC6C  # the number that old torch files start with
READ: dict[int, Any] = pickle._Unpickler.dispatch  # pyright: ignore[reportPrivateUsage]
REFUSED = b"".join((
    pickle.INST, pickle.OBJ, pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.PERSID,
    pickle.BINPERSID, pickle.NEWOBJ_EX, pickle.NEXT_BUFFER, pickle.READONLY_BUFFER,
))  # fmt: skip
"""Opcodes that would make more than data."""
BROKEN_PICKLE = (
    *BROKEN, OverflowError, AssertionError, struct.error, lzma.LZMAError, pickle.UnpicklingError,
)  # fmt: skip
PACKED: Mapping[bytes, Callable[[], Any]] = {
    b"\x1f\x8b": lambda: zlib.decompressobj(wbits=31),
    b"\x78": zlib.decompressobj,
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ\x00": lzma.LZMADecompressor,
    b"\x5d\x00": lzma.LZMADecompressor,
}
"""How files with these first bytes are unpacked."""
TYPES = re.compile(r"[<>=|]?(\?|[biufcSU][1-9]\d{0,6}|[bBhHiIlLqQefdFDgG]|O8?|object)")
"""Names of types of numbers, of text and of objects; no fields."""


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
        raise InputError(f"{name}: {not_there(path)}, expected a pickle")
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
    packed = next((head for head in PACKED if data.startswith(head)), None)
    if packed:
        unpacker = PACKED[packed]()
        data = unpacker.decompress(data, LARGEST + 1)
        if len(data) > LARGEST:
            raise InputError(f"unpacks to more than {LARGEST} bytes, expected at most that")
        if not unpacker.eof:
            raise ValueError("it ends too early")
    if data[:4] == b"PK\x03\x04":
        return _of_archive(data)
    if data[:6] == b"\x93NUMPY":
        header, _, data = data.partition(b"\n")
        if b"'|O'" not in header:
            raise ValueError("an .npy file of plain numbers, which is no pickle")
    value = Reader(BytesIO(data)).load()
    return _of_torch(data) if value == TORCH else value


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
        cure = ""
        if named and named[1].startswith("numpy"):
            held, cure = "holds numpy's arrays beside tensors", "; store both as one (x.numpy())"
        wanted = f"expected tensors, numbers, text and containers{cure}"
        raise InputError(f"{held}, {wanted}") from error
    if isinstance(value, torch.storage.TypedStorage):
        return torch.empty(0, dtype=value.dtype).set_(value)  # pyright: ignore[reportArgumentType]
    return value


def load_weights(path: Path, field: str, expected: str) -> dict[str, torch.Tensor]:
    """The tensors of a checkpoint by name, under a field where it has that; nothing in it runs.

    Raises:
        InputError: If the file is missing or broken, or holds no tensors by name.
    """
    if not path.is_file():
        raise InputError(f"{path}: {not_there(path)}, expected {expected}")
    try:
        tree = _of_torch(path.read_bytes())
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    except Exception as error:  # torch raises what the damage happens to cause
        raise unreadable(path, error, expected) from error
    tree = tree.get(field, tree) if isinstance(tree, dict) else tree
    named = tree.items() if isinstance(tree, dict) else ()
    state = {str(k): v.detach().float() for k, v in named if isinstance(v, torch.Tensor)}
    if not state:
        raise InputError(f"{path.name}: holds no parameters by name, expected {expected}")
    return state


class Row(tuple[Any, ...]):
    """A tuple that is a key only if its hash is quick: of numbers and text, not of more tuples."""

    __slots__ = ()

    def __hash__(self) -> int:
        if not all(isinstance(v, int | float | complex | str | bytes | None) for v in self):
            raise ValueError("a key that is no text, number or tuple of these")
        return super().__hash__()


class Call:
    """What a pickle would call, as data: name, arguments, and the state and items that follow."""

    def __init__(self, name: Any, args: Any, state: Any = None, items: Any = None) -> None:  # noqa: ANN401
        if not isinstance(name, Word):
            raise ValueError("a call of something that has no name")
        self.name, self.args, self.state, self.items = name, args, state, items or {}

    def __setitem__(self, key: object, value: object) -> None:
        self.items[key] = value


class Word(str):
    """A class or function that a pickle names, by its package: a word, not the thing."""

    __slots__ = ()

    def __call__(self, *args: Any) -> Call | set[Any]:  # noqa: ANN401
        """The call as data; of what is made for an object of a class, that of the class."""
        match str(self), args:
            case "copyreg.__newobj__", (kind, *rest):
                return Call(kind, tuple(rest))
            case "copyreg._reconstructor", (kind, "builtins.object", None):
                return Call(kind, ())
            case "builtins.set" | "builtins.frozenset", (list() | tuple() as items,):
                return set(items)  # which are hashed at once, as those of other sets
            case _:
                return Call(self, args)


class Reader(pickle._Unpickler):  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
    """Python's reader of a pickle, without any opcode that could import, call or set."""

    stack: list[Any]

    def __init__(self, stream: BytesIO) -> None:
        super().__init__(stream, encoding="latin1")
        self.stream = stream

    def find_class(self, module: str, name: str) -> Word:
        """The word for a class or function of the list, by its package and its own name.

        Raises:
            InputError: If it is not in the list; nothing was imported or called.
        """
        package = module.split(".")[0]
        if package == "chumpy" and name.isidentifier():
            return Word(f"{module}.{name}")
        word = Word(f"{PYTHON_2.get(package, package)}.{name}")
        if word in WORDS or word in MADE:
            return word
        shown = f"{module}.{name}"[:200].encode("unicode_escape").decode()
        raise InputError(f"the pickle holds {shown}, expected arrays, numbers, text and containers")

    def build(self) -> None:
        """BUILD: the state of a call; behind that of joblib lies an array."""
        state, call = self.stack.pop(), self.stack[-1]
        if not isinstance(call, Call):
            raise ValueError("a state for something that has none")
        call.state = state
        if call.name == "joblib.NumpyArrayWrapper":
            form = _plain(state, {}, 0)[0]
            if form["dtype"].hasobject:
                call.state = Reader(self.stream).load()
                return
            if form.get("numpy_array_alignment_bytes") is not None:
                self.stream.read(self.stream.read(1)[0])
            call.state = _filled(form["shape"], form["dtype"], form["order"], self.stream)

    def row(self, code: int) -> None:
        """TUPLE and its like: as a row."""
        READ[code](self)
        self.stack[-1] = Row(self.stack[-1])

    dispatch: ClassVar[dict[int, Any]] = {
        **{code: act for code, act in READ.items() if code not in REFUSED},
        **{code: lambda reader, code=code: reader.row(code) for code in b"t\x85\x86\x87"},
        pickle.NEWOBJ[0]: READ[pickle.REDUCE[0]],
        pickle.BUILD[0]: build,
        pickle.BYTEARRAY8[0]: READ[pickle.BINBYTES8[0]],
    }


def _plain(value: Any, done: dict[int, Any], depth: int) -> tuple[Any, int]:  # noqa: ANN401
    """A value as a tree with each call worked out, and its bytes if all that it shares is written.

    `done` has what was found for each thing by its id, None while that is not yet known.
    """
    if not isinstance(value, Call | Mapping | list | tuple | set | frozenset):
        return _leaf(value)
    if id(value) not in done:
        if depth >= DEEPEST:
            raise InputError(f"holds lists in lists in more than {DEEPEST} levels, expected fewer")
        done[id(value)] = None
        parts: Any = vars(value) if isinstance(value, Call) else value
        inside = parts.values() if isinstance(parts, Mapping) else parts
        found = [_plain(item, done, depth + 1) for item in inside]
        plain: Any = [item for item, _ in found]
        size = ITEM + sum(size for _, size in found)
        if isinstance(parts, Mapping):
            keys = (_plain(k, done, depth)[0] if isinstance(k, Call) else k for k in parts)
            plain = dict(zip(map(str, keys), plain, strict=True))
        elif isinstance(value, set | frozenset):
            plain = set(plain)
        if isinstance(value, Call):
            plain = MADE.get(value.name, _chumpy)(Call(**plain))
            if not isinstance(plain, list | dict):
                plain, size = _leaf(plain)
        if size > LARGEST:
            raise InputError(f"unfolds to more than {LARGEST} bytes, expected at most that")
        done[id(value)] = plain, size
    if done[id(value)] is None:
        raise InputError("holds a list that contains itself, expected a tree")
    return done[id(value)]


def _leaf(value: Any) -> tuple[Any, int]:  # noqa: ANN401
    """A value without parts, a tensor as an array, and its bytes."""
    if isinstance(value, torch.Tensor):
        held = value.untyped_storage().nbytes()
        if value.numel() * value.element_size() > max(held, REPEATED):
            raise ValueError("a tensor that is larger than what it holds")
        value = (value.float() if value.dtype == torch.bfloat16 else value).detach().numpy()
    letters = 4 * len(value) if isinstance(value, str | bytes) else 0
    return value, ITEM + letters + int(getattr(value, "nbytes", 0))


def _tensor(call: Call) -> torch.Tensor:
    """A tensor in a pickle of Python: a view of its storage."""
    storage, offset, size, stride = call.args[:4]
    try:
        return torch.from_numpy(storage).as_strided(size, stride, offset)
    except RuntimeError as error:
        raise ValueError("a tensor that is larger than what it holds") from error


def _python(call: Call) -> Any:  # noqa: ANN401
    """Containers, bytes, complex numbers and paths; none from a size."""
    match call.name.rpartition(".")[2], call.args:
        case "set" | "frozenset" | "list" | "tuple" | "Size", [] | [list()]:
            return call.args[0] if call.args else []
        case "dict" | "OrderedDict", [] | [list()]:
            return {str(key): value for key, value in dict(*call.args).items()} | call.items
        case "defaultdict", _:
            return call.items  # without the maker of defaults
        case "bytes" | "bytearray", [] | [bytes()]:
            return b"".join(call.args)
        case "bytes" | "bytearray" | "encode", [str() as text, "latin1" | "latin-1"]:
            return text.encode("latin1")
        case "complex", [float() as real, float() as imaginary]:
            return complex(real, imaginary)
        case "PosixPath" | "PurePosixPath" | "WindowsPath" | "PureWindowsPath", parts:
            return "/".join(parts).replace("//", "/")
        case _:
            raise ValueError(f"{call.name} of something else than text, lists or numbers")


def _dtype(call: Call) -> np.dtype[Any]:
    """A type of numbers, of text or of objects, in its order of bytes."""
    (name, *_), (_, order, *fields) = call.args, call.state
    if not TYPES.fullmatch(name) or any(x is not None for x in fields[:3]):
        raise ValueError("a type of something else than numbers and text")
    return np.dtype(name).newbyteorder(order)


def _filled(shape: Any, dtype: Any, fortran: Any, raw: Any) -> Any:  # noqa: ANN401
    """The array of these bytes, or the nested list of these objects, as many as the shape says."""
    if not isinstance(dtype, np.dtype) or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError("an array without type, or with an odd shape")
    order = "F" if fortran in (True, "F") else "C"
    if dtype.hasobject:
        return np.fromiter(raw, object, len(raw)).reshape(shape, order=order).tolist()
    size = math.prod(shape) * dtype.itemsize
    data = raw.read(size) if isinstance(raw, BytesIO) else raw
    data = data.encode("latin1") if isinstance(data, str) else data
    if not isinstance(data, bytes) or len(data) != size:
        raise ValueError("an array whose bytes do not fit its shape")
    return np.ndarray(shape, dtype, bytearray(data), order=order)


def _sparse(call: Call) -> Any:  # noqa: ANN401
    """A scipy matrix from its arrays, whose indices scipy checks."""
    from scipy import sparse

    state, kind = call.state, getattr(sparse, call.name.rpartition(".")[2])
    shape = state.get("_shape", state.get("shape"))
    if "indptr" not in state:
        return kind((state["data"], state.get("coords") or (state["row"], state["col"])), shape)
    matrix = kind((state["data"], state["indices"], state["indptr"]), shape)
    matrix.check_format(full_check=True)
    return matrix


def _chumpy(call: Call) -> np.ndarray:
    """The array in an object of chumpy: its value, or a selection, a new shape of another's."""
    match call.state:
        case {"x": np.ndarray() as value}:
            return value
        case {"a": np.ndarray() as base, "idxs": np.ndarray() as chosen, "preferred_shape": shape}:
            return base.ravel()[chosen].reshape(shape)
        case {"a": np.ndarray() as base, "newshape": shape}:
            return base.reshape(shape)
        case _:
            raise InputError(f"the pickle holds {call.name} without an array, expected its values")


PYTHON_2 = {"__builtin__": "builtins", "copy_reg": "copyreg"}
"""What its packages are called today."""
WORDS = {
    "copyreg._reconstructor", "copyreg.__newobj__", "numpy.ndarray", "numpy.memmap",
    *(f"builtins.{kind}" for kind in ("object", "int", "float", "str", "bool")),
    *(f"{package}.{kind}" for package in ("numpy", "torch") for kind in (
        "float16", "float32", "float64", "bfloat16", "bool", "uint8", "int8", "int16", "int32",
        "int64")),
}  # fmt: skip
"""What a pickle may name, but not call; but for copyreg's two, see `Word`."""
MADE: Mapping[str, Callable[[Call], Any]] = {
    **dict.fromkeys((
        *(f"builtins.{kind}" for kind in ("set", "frozenset", "list", "tuple", "dict", "bytes",
                                          "bytearray", "complex")),
        *(f"pathlib.{kind}Path" for kind in ("Posix", "PurePosix", "Windows", "PureWindows")),
        "collections.OrderedDict", "collections.defaultdict", "_codecs.encode", "torch.Size",
    ), _python),
    "numpy.dtype": _dtype,
    "numpy._reconstruct": lambda call: _filled(*call.state[-4:]),
    "numpy._frombuffer": lambda call: _filled(*(call.args[part] for part in (2, 1, 3, 0))),
    "numpy.scalar": lambda call: _filled([1], call.args[0], False, call.args[1])[0],
    **{f"scipy.{form}_{kind}": _sparse for form in ("csc", "csr", "coo")
       for kind in ("matrix", "array")},
    "joblib.NumpyArrayWrapper": lambda call: call.state,  # the reader put the array there
    "torch.device": lambda call: call.args[0],
    "torch._rebuild_parameter": lambda call: call.args[0],
    "torch._rebuild_tensor_v2": _tensor,
    "torch._load_from_bytes": lambda call: _plain(_of_torch(call.args[0]), {}, 0)[0],
}  # fmt: skip
"""What a pickle may call: worked out by functions that are all written here."""
