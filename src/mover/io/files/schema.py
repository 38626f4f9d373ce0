"""Schemas of JSON files: msgspec checks a value, and what it refuses is said with its field.

A schema is a `Struct` whose fields have the types below. Fields that it does not name are let be.
"""

import re
import types
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, overload

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from mover.io.files.fields import (
    FASTEST,
    LARGEST,
    LAST_ID,
    LAST_INDEX,
    MISSING,
    SLOWEST,
    At,
    refuse,
)

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
    try:
        return msgspec.convert(at.value, kind, dec_hook=_text)
    except msgspec.ValidationError as error:
        if "got `numpy." not in str(error):
            _refuse(at, kind, str(error))
    except UnicodeEncodeError:  # half of a pair of surrogates, which no text has
        pass
    return checked(At(_plain(at.value), at.file, at.field), kind)


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Numbers of numpy and text that is none, which msgspec does not take, as those of Python."""
    if isinstance(value, dict):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
        return "\0"
    return value.item() if isinstance(value, np.generic) else value


def rotation(at: At) -> NDArray[np.float64]:
    """A 3x3 rotation matrix, the nearest exact one."""
    given = np.array(checked(at, Rows))
    error = float(abs(given @ given.T - np.eye(3)).max())
    if not error < ROUGH or np.linalg.det(given) < 0:
        refuse(at, "a rotation matrix (orthonormal rows, determinant +1)")
    if error < EXACT:
        return given
    u, _, v = np.linalg.svd(given)
    return u @ v


def rigid(at: At) -> NDArray[np.float64]:
    """A 4 x 4 rigid transform of nested lists, its rotation the nearest exact one."""
    out = np.array(checked(at, tuple[Box, Box, Box, Box]))
    if out[3].tolist() != [0, 0, 0, 1]:
        refuse(at, "a rigid transform whose last row is 0 0 0 1")
    out[:3, :3] = rotation(At(out[:3, :3].tolist(), at.file, at.field))
    return out


def _text(kind: type, value: object) -> object:
    """The one type that msgspec does not know."""
    assert kind is Text
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise ValueError("no text")
    return Text(value)


def _refuse(at: At, kind: Any, said: str) -> NoReturn:  # noqa: ANN401
    """Say in our words what msgspec says: `Expected ... - at `$.objects[0].scale``."""
    path = re.search(r"`\$([^`]*)`$", said)
    for name, index in re.findall(r"\.(\w+)|\[([0-9]+|\.\.\.)\]", path[1] if path else ""):
        if index == "...":  # without the key
            _refuse_value(at, get_args(_bare(kind))[1])
        at, kind = _step(at, _bare(kind), name or int(index))
    if missing := re.match(r"Object missing required field `(\w+)`", said):
        at, kind = _step(at, _bare(kind), missing[1])
    wrong_length = isinstance(at.value, list | tuple) and "length" in said
    refuse(at, _expected(kind), f"{len(at.value)} items" if wrong_length else None)


def _refuse_value(at: At, kind: Any) -> NoReturn:  # noqa: ANN401
    """Refuse the first value of a dictionary that is wrong."""
    for key, value in at.value.items():
        checked(At(value, at.file, f"{at.field}.{key}" if at.field else key), kind)
    raise AssertionError(at.place)


def _step(at: At, kind: Any, key: str | int) -> tuple[At, Any]:  # noqa: ANN401
    """The field or item of a value, and its type."""
    if isinstance(key, int):
        kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
        inner = get_args(kind)[key if get_origin(kind) is tuple else 0]
        return At(at.value[key], at.file, f"{at.field}[{key}]"), inner
    value = at.value.get(key, MISSING)
    if isinstance(kind, tuple):  # structs that a field distinguishes
        config = kind[0].__struct_config__
        tags = [one.__struct_config__.tag for one in kind]
        if key == config.tag_field:
            kind = Literal[tuple(tags)]
        else:
            kind = _field(kind[tags.index(at.value[config.tag_field])], key)
    else:
        kind = _field(kind, key)
    return At(value, at.file, f"{at.field}.{key}" if at.field else key), kind


def _field(kind: type[Struct], key: str) -> Any:  # noqa: ANN401
    return next(f.type for f in msgspec.structs.fields(kind) if f.encode_name == key)


def _bare(kind: Any) -> Any:  # noqa: ANN401
    """A type without what may be left out; several structs as a tuple of them."""
    if get_origin(kind) in (Union, types.UnionType):
        rest = tuple(one for one in get_args(kind) if one is not types.NoneType)
        return _bare(rest[0]) if len(rest) == 1 else rest
    return kind


def _expected(kind: Any) -> str:  # noqa: ANN401
    """What a type takes, in words."""
    kind = _bare(kind)
    if get_origin(kind) is Annotated:
        base, meta = get_args(kind)
        if meta.description:
            return meta.description
        if base is int:
            return f"a whole number from {meta.ge} to {meta.le}"
        return f"a finite number from {meta.ge:g} to {meta.le:g}"
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"a list of {len(get_args(kind))}"
    words = {list: "a list", bool: "true or false", Text: "printable text"}
    return words.get(get_origin(kind) or kind, "an object {...}")
