"""Schemas of JSON files: what is refused is said with its field.

A schema is a `Struct` whose fields have the types below. Fields that it does not name are let be.
"""

import functools
import types
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, overload

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from mover.io.files.fields import FASTEST, LARGEST, LAST_ID, LAST_INDEX, SLOWEST, At

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST, description="a finite number")]
Positive = Annotated[float, Meta(ge=1 / LARGEST, le=LARGEST, description="a number above 0")]
Share = Annotated[float, Meta(ge=0, le=1)]
FrameRate = Annotated[float, Meta(ge=SLOWEST, le=FASTEST)]
"""Of a video [1/s]."""
Index = Annotated[int, Meta(ge=0, le=LAST_INDEX)]
"""Of a frame or a track."""
Id = Annotated[int, Meta(ge=0, le=LAST_ID)]
LARGEST_SIDE = 32768  # [px]
Side = Annotated[int, Meta(ge=1, le=LARGEST_SIDE)]
"""Of an image [px]."""
Vector = tuple[Number, Number, Number]
Sizes = tuple[Positive, Positive, Positive]
Box = tuple[Number, Number, Number, Number]
Rows = tuple[Vector, Vector, Vector]
"""A 3 x 3 matrix."""


class Text(str):
    """Printable text that is not blank."""


T = TypeVar("T")
ROUGH, EXACT = 1e-3, 1e-6  # rows of a rotation that is made exact; that is kept as it is


@overload
def checked(at: At, kind: type[T]) -> T: ...
@overload
def checked(at: At, kind: Any) -> Any: ...  # noqa: ANN401
def checked(at: At, kind: Any) -> Any:
    """The value as its schema has it.

    Raises:
        InputError: If a field is missing or wrong: file, field, found, expected.
    """
    at = at.holding(at.value.item()) if isinstance(at.value, np.generic) else at
    value, (origin, args) = at.value, _form(kind)
    if origin in (Union, types.UnionType):
        if value is None and types.NoneType in args:
            return None
        kinds = [one for one in args if one is not types.NoneType]
        return checked(at, kinds[0] if len(kinds) == 1 else _tagged(at, kinds))
    if origin is Annotated:
        return _within(at, *args)
    if origin is Literal:
        if not any(type(value) is type(one) and value == one for one in args):
            at.refuse("one of " + ", ".join(map(str, args)))
        return value
    if origin is tuple:
        return tuple(checked(*pair) for pair in zip(at.items(len(args)), args, strict=True))
    if origin is list:
        return [checked(item, args[0]) for item in at.items()]
    if origin is dict:
        return {key: checked(at.get(key), args[1]) for key in at.mapping()}
    if isinstance(kind, type) and issubclass(kind, Struct):
        there = at.mapping()
        given = [f for f in _fields(kind) if f.required or f.encode_name in there]
        given.sort(key=lambda f: f.encode_name not in there)  # what is wrong before what lacks
        return kind(**{f.name: checked(at.get(f.encode_name), f.type) for f in given})
    return PLAIN[kind](at) if kind in PLAIN else value


def _truth(at: At) -> bool:
    if not isinstance(at.value, bool):
        at.refuse("true or false")
    return at.value


PLAIN: Mapping[Any, Callable[[At], Any]] = {
    Text: At.text, str: At.text, float: At.number, bool: _truth,
    int: partial(At.integer, low=-LAST_ID, high=LAST_ID),
}  # fmt: skip


_fields = functools.cache(msgspec.structs.fields)
_form = functools.cache(lambda kind: (get_origin(kind), get_args(kind)))


def _tagged(at: At, kinds: list[type[Struct]]) -> type[Struct]:
    """Of several structs the one that a field names."""
    tags = {kind.__struct_config__.tag: kind for kind in kinds}
    field = at.get(kinds[0].__struct_config__.tag_field or "type")
    return tags[checked(field, Literal[tuple(tags)])]


def _within(at: At, base: Any, meta: Any) -> Any:  # noqa: ANN401
    """A number between bounds, or a list that is not too long."""
    if base is int:
        return at.integer(meta.ge, meta.le)
    if base is float:
        return at.number(meta.ge, meta.le, meta.description or "")
    if len(at.items()) > meta.max_length:
        at.refuse(meta.description, f"{len(at.value)} items")
    return checked(at, base)


def rotation(at: At) -> NDArray[np.float64]:
    """A 3x3 rotation matrix, the nearest exact one."""
    given = np.array(checked(at, Rows))
    error = float(abs(given @ given.T - np.eye(3)).max())
    if not error < ROUGH or np.linalg.det(given) < 0:
        at.refuse("a rotation matrix (orthonormal rows, determinant +1)")
    if error < EXACT:
        return given
    u, _, v = np.linalg.svd(given)
    return u @ v


def rigid(at: At) -> NDArray[np.float64]:
    """A 4 x 4 rigid transform of nested lists, its rotation the nearest exact one."""
    out = np.array(checked(at, tuple[Box, Box, Box, Box]))
    if out[3].tolist() != [0, 0, 0, 1]:
        at.refuse("a rigid transform whose last row is 0 0 0 1")
    out[:3, :3] = rotation(at.holding(out[:3, :3].tolist()))
    return out
