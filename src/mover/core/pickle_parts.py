"""What a pickle names: a short list of classes and functions whose data are understood.

A name that is in the list is a word, not the thing: what a file would do with it is a function of
this module. What gets its content later (an array, a matrix) is a `Part` until then.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mover.core.errors import InputError

REPEATED = 1 << 26
"""No tensor that repeats its numbers is larger [bytes]."""
TORCH_BYTES = "torch.storage._load_from_bytes"
JOBLIB = "joblib.numpy_pickle.NumpyArrayWrapper"
TYPES = re.compile(r"[<>=|]?(\?|[biufcSU]\d{1,7}|[bBhHiIlLqQefdFDgG]|O8?|object)")
"""Names of types of numbers, of text and of objects; no fields."""
STORAGES = {
    "Float": "<f4", "Double": "<f8", "Half": "<f2", "BFloat16": "<u2", "Long": "<i8",
    "Int": "<i4", "Short": "<i2", "Char": "|i1", "Byte": "|u1", "Bool": "|b1",
}  # fmt: skip
"""Type of the numbers in each of torch's storages."""
SIMPLE = (int, float, complex, str, bytes, type(None), np.generic)
RENAMED = {
    "__builtin__": "builtins", "copy_reg": "copyreg", "pathlib._local": "pathlib",
    "numpy._core.multiarray": "numpy.core.multiarray",
    "numpy._core.numeric": "numpy.core.numeric",
    **{f"scipy.sparse.{dash}{form}": "scipy.sparse" for dash in ("", "_")
       for form in ("csc", "csr", "coo")},
}  # fmt: skip
"""Modules that are the same as others: of Python 2, of other versions."""


class Name(str):
    """A class or function that a pickle names: a word, not the thing."""

    __slots__ = ()


class Part:
    """A thing whose content comes later: its name, its arguments, where the memo holds it."""

    __slots__ = ("args", "name", "places")

    def __init__(self, name: Name, args: tuple[Any, ...]) -> None:
        self.name, self.args = name, args
        self.places: list[int] = []


class Row(tuple[Any, ...]):
    """A tuple that is a key only if its hash is quick: of numbers and text, not of more tuples."""

    __slots__ = ()

    def __hash__(self) -> int:
        if not all(isinstance(v, SIMPLE) for v in self):
            raise ValueError("a key that is no text, number or tuple of these")
        return super().__hash__()


def named(module: str, name: str) -> Name:
    """The word for a class or function whose data are understood.

    Raises:
        InputError: If they are not; nothing was imported or called.
    """
    full = Name(f"{RENAMED.get(module, module)}.{name}")
    chumpy = module.split(".")[0] == "chumpy" and name.isidentifier()
    if not chumpy and not any(full in words for words in (WORDS, MAKERS, CONTENT)):
        shown = f"{module}.{name}"
        shown = shown if shown.isprintable() and len(shown) < 200 else "a class with an odd name"
        raise InputError(f"the pickle holds {shown}, expected arrays, numbers, text and containers")
    return full


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


def _bytes(raw: Any = b"", coding: Any = "latin1") -> bytes:  # noqa: ANN401
    """Bytes from text or bytes, never from a size."""
    if not isinstance(raw, str | bytes | list) or coding not in ("latin1", "latin-1"):
        raise ValueError("bytes from something else than text")
    return raw.encode("latin1") if isinstance(raw, str) else bytes(raw)


def _listed(items: Any = ()) -> Any:  # noqa: ANN401
    """The items of another container."""
    if not isinstance(items, list | tuple | set | frozenset):
        raise ValueError("a container of something else than a list")
    return items


def _dtype(part: Part, state: Any) -> np.dtype[Any]:  # noqa: ANN401
    if not isinstance(part.args[0], str) or not TYPES.fullmatch(part.args[0]):
        raise ValueError("a type of something else than numbers and text")
    found = np.dtype(part.args[0])
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
        return np.fromiter(raw, object, count).reshape(shape, order=order)
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


WORDS = {
    *(f"builtins.{name}" for name in ("object", "int", "float", "str", "bool")),
    *(f"{module}.{kind}{bits}" for module in ("numpy", "torch") for kind, sizes in
      (("float", (16, 32, 64)), ("int", (8, 16, 32, 64)), ("uint", (8,))) for bits in sizes),
    "numpy.ndarray", "numpy.memmap", "torch.bool", "torch.bfloat16",
    *(f"torch.{name}Storage" for name in STORAGES), "torch.storage.UntypedStorage",
}  # fmt: skip
"""Classes that a pickle may name, but not call."""
MAKERS: Mapping[str, Callable[..., Any]] = {
    "builtins.set": lambda *items: set(_listed(*items)),
    "builtins.frozenset": lambda *items: frozenset(_listed(*items)),
    "builtins.list": lambda *items: list(_listed(*items)),
    **dict.fromkeys(("builtins.tuple", "torch.Size"), lambda *items: Row(_listed(*items))),
    **dict.fromkeys(("builtins.dict", "collections.OrderedDict"), lambda pairs=(): dict(pairs)),
    "collections.defaultdict": lambda *_: {},  # its maker of defaults is not kept
    **dict.fromkeys(("builtins.bytes", "builtins.bytearray", "_codecs.encode"), _bytes),
    "builtins.complex": lambda *parts: complex(*parts),
    "copyreg._reconstructor": _rebuilt,
    "copyreg.__newobj__": lambda kind, *args: made(kind, args),
    **dict.fromkeys(
        (f"pathlib.{name}Path" for name in ("Posix", "PurePosix", "Windows", "PureWindows")),
        lambda *args: "/".join(args).replace("//", "/"),
    ),
    "numpy.core.multiarray.scalar": lambda dtype, raw: filled(raw, dtype, (1,), "C")[0],
    "numpy.core.numeric._frombuffer": filled,
    **dict.fromkeys(("torch.device", "torch._utils._rebuild_parameter"), lambda first, *_: first),
    "torch._utils._rebuild_tensor_v2": _tensor,
}  # fmt: skip
"""What is made at once, by functions that are all written here."""
CONTENT: Mapping[str, Callable[[Part, Any], Any] | None] = {
    "numpy.dtype": _dtype,
    "numpy.core.multiarray._reconstruct": _array,
    **{f"scipy.sparse.{form}_{kind}": _sparse for form in ("csc", "csr", "coo")
       for kind in ("matrix", "array")},
    JOBLIB: None, TORCH_BYTES: None,  # only the reader understands what lies behind them
}  # fmt: skip
"""What becomes whole with its content."""
