"""From the parts of a pickle to plain values: arrays, sparse matrices, numbers and containers."""

import math
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np

from ..records import InputError
from .arrays import READ, filled, storage
from .parts import Name, Part

SAFE = (int, float, str, bytes, bool, type(None), complex)


class Settler:
    """Turns a tree of parts into values; what is shared in the tree is shared in the values."""

    __slots__ = ("_done", "_keep", "_stored")

    def __init__(self, stored: Mapping[str, bytes]) -> None:
        self._stored = stored
        self._done: dict[int, Any] = {}
        self._keep: list[Any] = []

    def settle(self, item: Any) -> Any:  # noqa: ANN401
        """The value of a tree of parts.

        Raises:
            ValueError: If parts do not fit together.
            InputError: If a class gives no array.
        """
        if type(item) in SAFE:
            return item
        if id(item) in self._done:
            if self._done[id(item)] is self:
                raise ValueError("a thing that is a part of itself")
            return self._done[id(item)]
        self._keep.append(item)
        match item:
            case list() | dict() | set():
                self._done[id(item)] = item
                self._inside(item)
                return item
            case _:
                self._done[id(item)] = self
                self._done[id(item)] = self._value(item)
                return self._done[id(item)]

    def _inside(self, item: Any) -> None:  # noqa: ANN401
        """Settle the items of a container in place."""
        match item:
            case list():
                item[:] = [self.settle(x) for x in item]
            case dict():
                pairs = [(self.settle(k), self.settle(v)) for k, v in item.items()]
                item.clear()
                item.update(pairs)
            case _:
                values = [self.settle(x) for x in item]
                item.clear()
                item.update(values)

    def _value(self, item: Any) -> Any:  # noqa: ANN401
        match item:
            case tuple() | frozenset():
                return type(item)(self.settle(x) for x in item)
            case Part():
                return self._understood(item)
            case Name():
                return item.full
            case bytearray():
                return bytes(item)
            case _:
                raise ValueError("something that is no value")

    def _understood(self, part: Part) -> Any:  # noqa: ANN401
        kind, _, detail = part.name.kind.partition(" ")
        if kind == "type":
            return storage(part, self._stored)
        if kind == "wrapped":
            return part.state
        args, state = self.settle(part.args), self.settle(part.state)
        match kind:
            case "sparse":
                return _sparse(detail, state)
            case "chumpy":
                return _chumpy(part.name.full, state)
            case "stored":
                from .load import storage_of

                return storage_of(*args)
            case _ if kind in READ:
                return READ[kind](args, state)
            case _:
                raise ValueError(f"an object of {part.name.full}")


def _sparse(form: str, state: Any) -> Any:  # noqa: ANN401
    """A scipy matrix from its arrays, whose indices scipy checks."""
    from scipy import sparse

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


def _chumpy(full: str, state: Any) -> np.ndarray:  # noqa: ANN401
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
            raise InputError(f"the pickle holds {full} without an array, expected its values")


def unwrapped(stream: BytesIO, state: Any) -> Any:  # noqa: ANN401
    """The array that joblib wrote behind its description.

    Raises:
        ValueError: If the description is odd or the bytes are not there.
    """
    from .machine import Machine

    form = Settler({}).settle(state)
    dtype, shape = form["dtype"], form["shape"]
    if not isinstance(dtype, np.dtype) or not isinstance(shape, tuple):
        raise ValueError("an array without type or shape")
    if dtype.hasobject:
        return Settler({}).settle(Machine(stream).run())
    if form.get("numpy_array_alignment_bytes") is not None:
        stream.read(stream.read(1)[0])
    return filled(
        stream.read(math.prod(shape) * dtype.itemsize), dtype, shape, form["order"] == "F"
    )
