"""What a pickle names: a short list of classes and functions whose data are understood.

A name that is not in the list is refused as soon as it appears. A name that is in it is a word, not
the thing: what a file would do with it is one of the makers below. What gets its content later (an
array, a matrix) is a `Part` until then.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from mover.core.errors import InputError

LARGEST = 2 << 30
"""No file and no array is larger [bytes]."""
REPEATED = 1 << 26
"""No tensor that repeats its numbers is larger [bytes]."""
TORCH_BYTES = "torch.storage._load_from_bytes"
JOBLIB = "joblib.numpy_pickle.NumpyArrayWrapper"
NUMBERS = re.compile(r"[<>=|]?(\?|[biufcSU]\d{1,7}|[bBhHiIlLqQefdFDgG])")
"""Names of types of numbers and of text; no objects, no fields."""
STORAGES = {
    "Float": "<f4", "Double": "<f8", "Half": "<f2", "BFloat16": "<u2", "Long": "<i8",
    "Int": "<i4", "Short": "<i2", "Char": "|i1", "Byte": "|u1", "Bool": "|b1",
}  # fmt: skip
"""Type of the numbers in each of torch's storages."""
SIMPLE = (int, float, complex, str, bytes, type(None), np.generic)


class Name(str):
    """A class or function that a pickle names: a word, not the thing."""

    __slots__ = ()


class Part:
    """A thing whose content comes later: its name, its arguments, where the memo holds it."""

    __slots__ = ("args", "name", "places")

    def __init__(self, name: Name, args: tuple[Any, ...]) -> None:
        self.name, self.args = name, args
        self.places: list[int] = []


def named(module: str, name: str) -> Name:
    """The word for a class or function whose data are understood.

    Raises:
        InputError: If they are not; nothing was imported or called.
    """
    full = Name(f"{module}.{name}")
    chumpy = module.split(".")[0] == "chumpy" and name.isidentifier()
    if not chumpy and not any(full in words for words in (WORDS, MAKERS, CONTENT, BEHIND)):
        shown = full if full.isprintable() and len(full) < 200 else "a class with an odd name"
        raise InputError(f"the pickle holds {shown}, expected arrays, numbers, text and containers")
    return full


def keyed(items: Iterable[Any]) -> Iterator[Any]:
    """Things that are found by their value: text, numbers, or tuples of these, whose hash is quick.

    Raises:
        ValueError: If one is anything else.
    """
    for item in items:
        if not all(isinstance(v, SIMPLE) for v in (item if type(item) is tuple else (item,))):
            raise ValueError("a key that is no text, number or tuple of these")
        yield item


def made(name: Any, args: Any) -> Any:  # noqa: ANN401
    """What `name(*args)` describes: a container, an array, or a part whose content follows.

    Raises:
        ValueError: If the name is none or the arguments do not fit.
    """
    if not isinstance(name, Name) or not isinstance(args, tuple):
        raise ValueError("a call of something that has no name")
    if name in MAKERS:
        return MAKERS[name](*args)
    if name in WORDS:
        raise ValueError(f"a call of {name}")
    return Part(name, args)


def _rebuilt(kind: Any, base: Any, state: Any) -> Any:  # noqa: ANN401
    """An object of a class, as protocols 0 and 1 make it."""
    if not isinstance(base, Name) or not base.endswith(".object") or state is not None:
        raise ValueError("an object of another class's")
    return made(kind, ())


def _bytes(*args: Any) -> bytes:  # noqa: ANN401
    """Bytes from text or bytes, never from a size."""
    match args:
        case ():
            return b""
        case (bytes() as raw,):
            return raw
        case (str() as text,) | (str() as text, "latin1" | "latin-1"):
            return text.encode("latin1")
        case (list() as numbers,):
            return bytes(numbers)
        case _:
            raise ValueError("bytes from something else than text")


def _dict(*args: Any) -> dict[Any, Any]:  # noqa: ANN401
    """A dictionary of pairs."""
    pairs = [(key, value) for key, value in (args[0] if args else ())]
    return dict(zip(keyed(key for key, _ in pairs), (value for _, value in pairs), strict=True))


def _of_list(kind: Callable[..., Any]) -> Callable[..., Any]:
    """A container of the items of another one."""

    def build(*args: Any) -> Any:  # noqa: ANN401
        if any(not isinstance(a, list | tuple | set | frozenset) for a in args) or len(args) > 1:
            raise ValueError("a container of something else than a list")
        return kind(*args)

    return build


def _set(items: Iterable[Any] = ()) -> set[Any]:
    return set(keyed(items))


def _frozen(items: Iterable[Any] = ()) -> frozenset[Any]:
    return frozenset(keyed(items))


def _first(*args: Any) -> Any:  # noqa: ANN401
    """A parameter's tensor, a device's name."""
    return args[0]


def _nothing(*_: Any) -> dict[Any, Any]:  # noqa: ANN401
    """A dictionary whose maker of defaults is not kept."""
    return {}


def _new(kind: Any, *args: Any) -> Any:  # noqa: ANN401
    """An object of a class, as a function makes it."""
    return made(kind, args)


def _scalar(dtype: Any, raw: Any) -> Any:  # noqa: ANN401
    return filled(raw, dtype, (1,), "C")[0]


def _path(*args: str) -> str:
    return "/".join(args).replace("//", "/")


def _complex(*args: Any) -> complex:  # noqa: ANN401
    if not all(isinstance(a, float | int) for a in args):
        raise ValueError("a complex number of something else than numbers")
    return complex(*args)


def _dtype(part: Part, state: Any) -> np.dtype[Any]:  # noqa: ANN401
    """A type of numbers or text; an object's type is told by `O`."""
    name = part.args[0]
    if not isinstance(name, str):
        raise ValueError("a type without a name")
    if name in ("O", "O8", "object"):
        return np.dtype("O")
    if not NUMBERS.fullmatch(name):
        raise ValueError("a type of something else than numbers and text")
    found = np.dtype(name)
    if isinstance(state, tuple) and len(state) > 4:
        if any(x is not None for x in state[2:5]):
            raise ValueError("a type with fields")
        if state[1] in ("<", ">"):
            found = found.newbyteorder(state[1])
    return found


def filled(raw: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:  # noqa: ANN401
    """The array of these bytes, or of the objects of a list.

    Raises:
        ValueError: If they are not as many as the shape says.
    """
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple):
        raise ValueError("an array without type or shape")
    if not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 32:
        raise ValueError("an array with an odd shape")
    count = math.prod(shape)
    if dtype.hasobject:
        if not isinstance(raw, list) or len(raw) != count:
            raise ValueError("an array with the wrong number of objects")
        array = np.empty(count, object)
        for index, item in enumerate(raw):
            array[index] = item
        return array.reshape(shape, order=order)
    data = raw.encode("latin1") if isinstance(raw, str) else raw
    if not isinstance(data, bytes) or len(data) != count * dtype.itemsize:
        raise ValueError("an array whose bytes do not fit its shape")
    if not count or not dtype.itemsize:
        return np.zeros((0,) if not dtype.itemsize else shape, dtype)
    return np.frombuffer(bytearray(data), dtype).reshape(shape, order=order)


def _array(part: Part, state: Any) -> np.ndarray:  # noqa: ANN401
    if part.args[0] not in ("numpy.ndarray", "numpy.memmap") or not isinstance(state, tuple):
        raise ValueError("an array without content")
    shape, dtype, fortran, raw = state[-4:]
    return filled(raw, dtype, shape, "F" if fortran else "C")


def storage_type(kind: str) -> np.dtype[Any]:
    """The type of the numbers of a storage of torch."""
    name = kind.removeprefix("torch.").removesuffix("Storage")
    if name not in STORAGES:
        raise ValueError(f"an object of {kind}")
    return np.dtype(STORAGES[name])


def storage_of(kind: str, raw: bytes) -> np.ndarray:
    """The numbers of a storage of torch; those of bfloat16 as floats."""
    dtype = storage_type(kind)
    array = np.frombuffer(raw, dtype, count=len(raw) // dtype.itemsize)
    if "BFloat16" in kind:
        return (array.astype(np.uint32) << 16).view(np.float32)
    return array.copy()


def _tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> np.ndarray:  # noqa: ANN401
    """A tensor of torch as an array: a view of its storage."""
    whole = all(type(n) is int and n >= 0 for n in (offset, *size, *stride))
    if not whole or not isinstance(storage, np.ndarray) or len(size) != len(stride):
        raise ValueError("a tensor with an odd shape")
    if 0 in size:
        return np.zeros(size, storage.dtype)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    most = max(storage.nbytes, REPEATED)
    if last >= len(storage) or math.prod(size) * storage.itemsize > most or len(size) > 32:
        raise ValueError("a tensor that is larger than what it holds")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps)


def _sparse(part: Part, state: Any) -> Any:  # noqa: ANN401
    """A scipy matrix from its arrays, whose indices scipy checks."""
    from scipy import sparse

    form = part.name.rpartition(".")[2][:3]
    shape = state.get("_shape", state.get("shape"))
    parts = ("row", "col") if form == "coo" else ("indices", "indptr")
    index = state["coords"] if form == "coo" and "coords" in state else [state[p] for p in parts]
    arrays = [state["data"], *index]
    if not all(isinstance(a, np.ndarray) and a.ndim == 1 for a in arrays) or len(shape) != 2:
        raise ValueError("a sparse matrix without its arrays")
    if form == "coo":
        return sparse.coo_matrix((arrays[0], (arrays[1], arrays[2])), shape=shape)
    kind = sparse.csc_matrix if form == "csc" else sparse.csr_matrix
    matrix = kind(tuple(arrays), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def chumpy_array(part: Part, state: Any) -> np.ndarray:  # noqa: ANN401
    """The array in an object of chumpy: its value, or a selection from, a new shape of another's.

    Raises:
        InputError: If it is computed from others in another way.
    """
    match state:
        case {"x": np.ndarray() as value}:
            return value
        case {"a": np.ndarray() as base, "idxs": np.ndarray() as chosen, "preferred_shape": shape}:
            return base.ravel()[chosen].reshape(shape)
        case {"a": np.ndarray() as base, "newshape": shape}:
            return base.reshape(shape)
        case _:
            raise InputError(f"the pickle holds {part.name} without an array, expected its values")


def _under(modules: str, names: str) -> list[str]:
    """Full names: each of some modules with each of some names."""
    return [f"{module}.{name}" for module in modules.split() for name in names.split()]


PATHS = "PosixPath PurePosixPath WindowsPath PureWindowsPath"
BUILTINS, COPYREG = "builtins __builtin__", "copyreg copy_reg"
NUMPY = "numpy.core numpy._core"
SCIPY = " ".join(
    f"scipy.sparse.{dash}{form}" for dash in ("", "_") for form in ("csc", "csr", "coo")
)
WORDS = {
    *_under(BUILTINS, "object int float str bool"),
    *_under("numpy", "ndarray memmap float64 float32 float16 int64 int32 int16 int8 uint8"),
    *_under("torch", "float64 float32 float16 int64 int32 int16 int8 uint8 bool bfloat16"),
    *(f"torch.{name}Storage" for name in STORAGES), "torch.storage.UntypedStorage",
}  # fmt: skip
"""Classes that a pickle may name, but not call."""
BEHIND = (JOBLIB, TORCH_BYTES)
"""What only the reader itself understands: it lies behind its description in the file."""
MAKERS: Mapping[str, Callable[..., Any]] = {
    **dict.fromkeys(_under(BUILTINS, "set"), _of_list(_set)),
    **dict.fromkeys(_under(BUILTINS, "frozenset"), _of_list(_frozen)),
    **dict.fromkeys(_under(BUILTINS, "list"), _of_list(list)),
    **dict.fromkeys([*_under(BUILTINS, "tuple"), "torch.Size"], _of_list(tuple)),
    **dict.fromkeys([*_under(BUILTINS, "dict"), "collections.OrderedDict"], _dict),
    **dict.fromkeys([*_under(BUILTINS, "bytes bytearray"), "_codecs.encode"], _bytes),
    **dict.fromkeys(_under(BUILTINS, "complex"), _complex),
    **dict.fromkeys(_under(COPYREG, "_reconstructor"), _rebuilt),
    **dict.fromkeys(_under(COPYREG, "__newobj__"), _new),
    **dict.fromkeys(_under("pathlib pathlib._local", PATHS), _path),
    **dict.fromkeys(_under(NUMPY, "multiarray.scalar"), _scalar),
    **dict.fromkeys(_under(NUMPY, "numeric._frombuffer"), filled),
    "collections.defaultdict": _nothing,
    "torch.device": _first,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _first,
}
"""What is made at once, by functions that are all written here."""
CONTENT: Mapping[str, Callable[[Part, Any], Any]] = {
    "numpy.dtype": _dtype,
    **dict.fromkeys(_under(NUMPY, "multiarray._reconstruct"), _array),
    **dict.fromkeys(
        _under(SCIPY, "csc_matrix csc_array csr_matrix csr_array coo_matrix coo_array"), _sparse
    ),
}
"""What becomes whole with its content."""
