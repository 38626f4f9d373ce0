"""Arrays, numbers and tensors from the parts of a pickle, checked against the bytes they have."""

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .parts import STORAGES, Part

LARGEST = 2 << 30
"""No file and no array is larger [bytes]."""
PLAIN = re.compile(r"[<>=|]?(\?|[biufcSU]\d{1,7}|[bBhHiIlLqQefdFDgG])")
"""Names of types of numbers and of text; no objects, no fields."""


def _dtype(args: Any, state: Any) -> np.dtype[Any]:  # noqa: ANN401
    """A type of numbers or text; an object's type is told by `O`."""
    name = args[0]
    if not isinstance(name, str):
        raise ValueError("a type without a name")
    if name in ("O", "O8", "object"):
        return np.dtype("O")
    if not PLAIN.fullmatch(name):
        raise ValueError("a type of something else than numbers and text")
    found = np.dtype(name)
    if isinstance(state, tuple) and len(state) > 4:
        if any(x is not None for x in state[2:5]):
            raise ValueError("a type with fields")
        if state[1] in ("<", ">"):
            found = found.newbyteorder(state[1])
    return found


def filled(raw: Any, dtype: Any, shape: Any, fortran: bool) -> np.ndarray:  # noqa: ANN401
    """The array of these bytes, or of the objects of a list.

    Raises:
        ValueError: If they are not as many as the shape says.
    """
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple):
        raise ValueError("an array without type or shape")
    if not all(type(n) is int and n >= 0 for n in shape) or len(shape) > 32:
        raise ValueError("an array with an odd shape")
    count, order = math.prod(shape), "F" if fortran else "C"
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


def _array(args: Any, state: Any) -> np.ndarray:  # noqa: ANN401
    if args[0] not in ("numpy.ndarray", "numpy.memmap") or not isinstance(state, tuple):
        raise ValueError("an array without content")
    shape, dtype, fortran, raw = state[-4:]
    return filled(raw, dtype, shape, bool(fortran))


def _scalar(args: Any, state: Any) -> Any:  # noqa: ANN401, ARG001
    dtype, raw = args
    return filled(raw, dtype, (1,), False)[0]


def _buffer(args: Any, state: Any) -> np.ndarray:  # noqa: ANN401, ARG001
    raw, dtype, shape, order = args
    return filled(raw, dtype, shape, order == "F")


def _tensor(args: Any, state: Any) -> np.ndarray:  # noqa: ANN401, ARG001
    """A torch tensor as an array: a view of its storage, copied."""
    storage, offset, size, stride = args[:4]
    whole = all(type(n) is int and n >= 0 for n in (offset, *size, *stride))
    if not whole or not isinstance(storage, np.ndarray) or len(size) != len(stride):
        raise ValueError("a tensor with an odd shape")
    if 0 in size:
        return np.zeros(size, storage.dtype)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if last >= len(storage) or math.prod(size) * storage.itemsize > LARGEST or len(size) > 32:
        raise ValueError("a tensor that is larger than what it holds")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()


def _parameter(args: Any, state: Any) -> Any:  # noqa: ANN401, ARG001
    return args[0]


READ: dict[str, Callable[[Any, Any], Any]] = {
    "dtype": _dtype,
    "array": _array,
    "scalar": _scalar,
    "buffer": _buffer,
    "tensor": _tensor,
    "parameter": _parameter,
}


def storage(part: Part, stored: Mapping[str, bytes]) -> np.ndarray:
    """The numbers that a torch file keeps under a key."""
    name = part.name.full.removeprefix("torch.").removesuffix("Storage")
    if name not in STORAGES or len(part.args) != 2 or part.args[0] not in stored:
        raise ValueError(f"an object of {part.name.full}")
    raw = stored[part.args[0]]
    dtype = np.dtype(STORAGES[name])
    array = np.frombuffer(raw, dtype, count=len(raw) // dtype.itemsize)
    if name == "BFloat16":
        return (array.astype(np.uint32) << 16).view(np.float32)
    return array
