"""Records: frozen dataclasses of tensors that are checked, mapped, moved, saved and hashed."""

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache, wraps
from pathlib import Path
from typing import Any, TypeVar, dataclass_transform

import numpy as np
import torch
from beartype import BeartypeConf, beartype
from jaxtyping import jaxtyped
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import BROKEN, replacing

T = TypeVar("T")
MOST = 1000  # combinations of shapes that a record remembers
_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


@dataclass_transform(frozen_default=True)
def record(cls: type[T]) -> type[T]:
    """Make a frozen dataclass whose dtypes and shapes are checked when it is built."""
    made: Any = dataclasses.dataclass(frozen=True, eq=False)(cls)
    plain = made.__init__
    plain.__annotations__.pop("return")  # else all is checked once more, after the call
    checked = cache(lambda: jaxtyped(typechecker=_check)(plain))  # made where it is built first
    known: set[tuple[Any, ...]] = set()  # what has passed: loops build the same thousands of times

    @wraps(plain)
    def init(self: Any, *args: Any, **fields: Any) -> None:  # noqa: ANN401
        kind = (*map(_kind, args), *fields, *map(_kind, fields.values()))
        if kind in known:
            plain(self, *args, **fields)
            return
        checked()(self, *args, **fields)
        if None not in kind and len(known) < MOST:
            known.add(kind)

    made.__init__ = init
    return made


def _kind(value: object) -> object:
    """All of a value that a check of a record looks at; None: its parts are looked at, too."""
    if isinstance(value, Tensor):
        return value.dtype, value.shape
    if type(value) is tuple and len(value) == 1:  # such as the mask of one annotation
        kind = _kind(value[0])
        return None if kind is None else (tuple, kind)
    simple = value is None or isinstance(value, (bool, int, float, bytes))
    return type(value) if simple or dataclasses.is_dataclass(value) else None


def map_tensors(fn: Callable[[Tensor], Tensor], value: T) -> T:
    """Return a copy of `value` with `fn` applied to each tensor inside."""
    found: Any = value
    match found:
        case Tensor():
            found = fn(found)
        case tuple():
            found = tuple(map_tensors(fn, v) for v in found)
        case Mapping():
            found = {k: map_tensors(fn, v) for k, v in found.items()}
        case _ if dataclasses.is_dataclass(found) and not isinstance(found, type):
            names = [f.name for f in dataclasses.fields(found)]
            parts = {n: map_tensors(fn, getattr(found, n)) for n in names}
            found = dataclasses.replace(found, **parts)
        case _:
            pass
    return typing.cast(T, found)


def to_device(value: T, device: torch.device | str) -> T:
    """Return a copy of `value` on `device`."""
    return map_tensors(lambda x: x.to(device), value)


def rows_of(value: T, rows: Tensor, *axes: str) -> T:
    """Some rows of a record: of its tensors with an axis of such a name, its dicts and its masks.

    Args:
        value: The record; other fields stay as they are.
        rows: Numbers of rows, or which are kept.
        axes: Names in the annotations, by default `bodies` and `rows`.
    """
    index = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
    return _by_rows(lambda axis, part: part.index_select(axis, index.to(part.device)), axes, value)


def with_rows(value: T, rows: Tensor, part: T, *axes: str) -> T:
    """The record with the rows of another in place of some of its own, as `rows_of` takes them."""
    return _by_rows(
        lambda axis, a, b: a.index_copy(axis, rows.to(a.device), b.to(a)), axes, value, part
    )


def _by_rows(fn: Callable[..., Tensor], axes: tuple[str, ...], value: T, *others: T) -> T:
    """A record of what `fn` makes of the rows of each part, by their axis, of one or more."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(typing.cast(Any, value)):
        part, *more = (getattr(one, field.name) for one in (value, *others))
        axis = axis_of(field.type, axes or ("bodies", "rows"))
        if isinstance(part, Tensor) and axis is not None:
            part = fn(axis, part, *more)
        elif isinstance(part, dict):
            tensors = {n: fn(0, one, *(other[n] for other in more))
                       for n, one in part.items() if isinstance(one, Tensor)}  # fmt: skip
            part = part | tensors
        elif isinstance(part, tuple) and part and all(isinstance(one, bytes) for one in part):
            masks = [mask for one in (part, *more) for mask in one]
            numbers = torch.arange(len(masks)).split([len(one) for one in (part, *more)])
            part = tuple(masks[row] for row in fn(0, *numbers).tolist())
        elif isinstance(part, tuple) and all(dataclasses.is_dataclass(one) for one in part):
            part = tuple(_by_rows(fn, axes, *each) for each in zip(part, *more, strict=True))
        elif dataclasses.is_dataclass(part):
            part = _by_rows(fn, axes, part, *more)
        found[field.name] = part
    return dataclasses.replace(typing.cast(Any, value), **found)


@cache
def axis_of(kind: Any, axes: tuple[str, ...]) -> int | None:  # noqa: ANN401
    """The axis of one of these names in a tensor's annotation, from the end, if there is one."""
    for one in (kind, *typing.get_args(kind)):
        names = getattr(one, "dim_str", "").split()
        for place, name in enumerate(names):
            if name in axes:
                return place - len(names)
    return None


def save(value: Any, path: Path) -> None:  # noqa: ANN401
    """Write `value` as `path`.npz for the tensors and then `path`.json for the structure.

    The JSON file also holds a digest of both and of the path's last two names.
    """
    tensors: dict[str, Any] = {}
    tree = _split(value, "", tensors)
    with replacing(path.with_suffix(".npz")) as part:
        np.savez(part, **tensors)
    with replacing(path.with_suffix(".json")) as part:
        digest = _digest(tree, tensors, path)
        part.write_text(json.dumps({"digest": digest, "record": tree}))


def load(kind: type[T], path: Path) -> T:
    """Read a record of type `kind` written by `save`.

    Raises:
        InputError: If the files are damaged, incomplete, or were written under another name.
    """
    try:
        whole = json.loads(path.with_suffix(".json").read_text())
        with path.with_suffix(".npz").open("rb") as file:
            tree, arrays = whole["record"], dict(np.load(file, allow_pickle=False))
        if whole["digest"] == _digest(tree, arrays, path):
            return typing.cast(T, _join(kind, tree, arrays))
        reason = "its digest is another"
    except BROKEN as error:
        reason = f"{type(error).__name__}: {error}"
    raise InputError(f"{path}: is damaged ({reason}), expected the files as they were written")


def fingerprint(*values: Any) -> str:  # noqa: ANN401
    """Short hash of the content of records: equal content, equal name on disk."""
    tensors: dict[str, Any] = {}
    tree = [_split(v, str(i), tensors) for i, v in enumerate(values)]
    return _hashed(tree, tensors)[:16]


def plain(value: Any) -> Any:  # noqa: ANN401
    """A record without tensors as plain JSON values."""
    return _split(value, "", {})


def _digest(tree: Any, tensors: dict[str, Any], path: Path) -> str:  # noqa: ANN401
    """Of a record under its name, so that another's file is not taken for it."""
    return _hashed([path.parent.name, path.name, tree], tensors)


def _hashed(tree: Any, tensors: dict[str, Any]) -> str:  # noqa: ANN401
    digest = hashlib.sha256(json.dumps(tree, sort_keys=True).encode())
    for name in sorted(tensors):
        array = np.ascontiguousarray(tensors[name])
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _split(value: Any, key: str, tensors: dict[str, Any]) -> Any:  # noqa: ANN401
    match value:
        case Tensor():
            tensors[key] = value.detach().cpu().numpy()
            return {"tensor": key}
        case bytes():
            return {"bytes": value.decode("latin-1")}
        case tuple() | list():
            return [_split(v, f"{key}.{i}", tensors) for i, v in enumerate(value)]
        case Mapping():
            return {k: _split(v, f"{key}.{k}", tensors) for k, v in value.items()}
        case Path():
            return str(value)
        case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
            names = [f.name for f in dataclasses.fields(value)]
            return {n: _split(getattr(value, n), f"{key}.{n}", tensors) for n in names}
        case _:
            return value


def _join(kind: Any, tree: Any, arrays: dict[str, Any]) -> Any:  # noqa: ANN401
    if tree is None:
        return None
    if typing.get_origin(kind) in (typing.Union, types.UnionType):  # the kind with these fields
        kinds = [k for k in typing.get_args(kind) if k is not types.NoneType]
        fits = (k for k in kinds if dataclasses.is_dataclass(k) and isinstance(tree, dict)
                and {f.name for f in dataclasses.fields(k)} == set(tree))  # fmt: skip
        kind = next(fits, kinds[0])
    if isinstance(tree, dict) and set(tree) == {"tensor"}:
        return torch.from_numpy(arrays[tree["tensor"]])
    if isinstance(tree, dict) and set(tree) == {"bytes"}:
        return tree["bytes"].encode("latin-1")
    origin, args = typing.get_origin(kind) or kind, typing.get_args(kind)
    if dataclasses.is_dataclass(origin):
        hints = typing.get_type_hints(origin)
        return kind(**{k: _join(hints[k], v, arrays) for k, v in tree.items()})
    if isinstance(tree, dict):
        return {k: _join(args[1], v, arrays) for k, v in tree.items()}
    if isinstance(tree, list):
        kinds = args[:1] * len(tree) if Ellipsis in args else args
        return tuple(_join(k, v, arrays) for k, v in zip(kinds, tree, strict=True))
    return tree
