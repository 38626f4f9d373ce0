"""Settings: each number says its range where it is declared, for flags, files and `--help`.

    yaws: Annotated[int, int_in(1, 360)] = 16

Imports no torch: `--help` is quick.
"""

import dataclasses
import functools
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from tyro.constructors import PrimitiveConstructorSpec

from mover.core.errors import InputError

MOST_SHOWN = 60  # letters of a wrong value in a message
UNIONS = (Union, types.UnionType)
WORDS = {bool: "true or false", str: "text", Path: "a path", types.NoneType: "nothing"}


@dataclass(frozen=True, kw_only=True)
class Range(PrimitiveConstructorSpec[Any]):
    """The numbers that a setting may be; both ends belong to it. Tyro shows it in `--help`."""

    low: float
    high: float
    kind: type[int] | type[float]
    unit: str = ""

    def words(self) -> str:
        """As messages say it."""
        noun = "a whole number" if self.kind is int else "a number"
        return f"{noun} from {_short(self.low)} to {_short(self.high)} {self.unit}".rstrip()

    def holds(self, value: object) -> bool:
        """Whether a value is such a number; NaN is none."""
        is_number = isinstance(value, self.kind) or (self.kind is float and isinstance(value, int))
        if isinstance(value, bool) or not is_number:
            return False
        return self.low <= typing.cast(float, value) <= self.high


def _range(kind: type[int] | type[float], low: float, high: float, unit: str = "") -> Range:
    return Range(
        nargs=1,
        metavar=f"{kind.__name__.upper()}:{_short(low)}..{_short(high)}",
        instance_from_str=lambda words: kind(words[0]),
        is_instance=lambda value: type(value) is kind or (kind is float and type(value) is int),
        str_from_instance=lambda value: [str(value)],
        low=low, high=high, kind=kind, unit=unit,
    )  # fmt: skip


int_in = functools.partial(_range, int)
"""The range of a whole number."""
float_in = functools.partial(_range, float)
"""The range of a number; it may end at infinity."""


def _short(number: float) -> str:
    return f"{number:,.0f}" if 1e3 <= abs(number) < 1e7 else f"{number:g}"


Share = Annotated[float, float_in(0, 1)]
Weight = Annotated[float, float_in(0, 1e9)]
"""Of a term of an energy; 0 leaves it out."""
Sigma = Annotated[float, float_in(1e-6, 1e6)]
"""What an expected error or a scale may be: it divides."""
Metres = Annotated[float, float_in(0, 100)]
Seconds = Annotated[float, float_in(0, 1e6)]
Rate = Annotated[float, float_in(1e-3, 1e4)]
"""Of frames a second."""
Count = Annotated[int, int_in(1, 1_000_000)]
Steps = Annotated[int, int_in(0, 1_000_000)]
"""Of a descent, or rounds of one; 0: none."""
Index = Annotated[int, int_in(0, 2**31 - 1)]
"""Of a frame."""


@functools.cache
def settings_of(kind: type[Any]) -> dict[str, Any]:
    """The types of a dataclass's fields, with their ranges."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def check_settings(settings: object, name: str) -> None:
    """Check every setting of a dataclass and of those inside.

    Args:
        settings: The dataclass.
        name: How messages call it: `--` for flags.

    Raises:
        InputError: If one is of a wrong type, or out of its range.
    """
    for key, hint in settings_of(type(settings)).items():
        flat = any(getattr(one, "name", None) == "" for one in getattr(hint, "__metadata__", ()))
        _check(getattr(settings, key), hint, name if flat else _joined(name, key))


def _joined(name: str, key: str) -> str:
    return f"{name}{key}" if name in ("--", "") else f"{name}.{key}"


def _check(value: Any, hint: Any, name: str) -> None:  # noqa: ANN401
    if expected := _wrong(value, hint, name):
        shown = repr(value)
        shown = shown if len(shown) <= MOST_SHOWN else shown[:MOST_SHOWN] + "..."
        raise InputError(f"{name}: has {shown}, expected {expected}")


def _wrong(value: Any, hint: Any, name: str) -> str:  # noqa: ANN401
    """What is expected in place of a value; empty: it fits."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        span = next((one for one in args[1:] if isinstance(one, Range)), None)
        if span is None:
            return _wrong(value, args[0], name)
        return "" if span.holds(value) else span.words()
    if origin in UNIONS:
        wrong = [_wrong(value, kind, name) for kind in args]
        return "" if "" in wrong else wrong[0]
    if origin is Literal:
        return "" if value in args else f"one of {', '.join(map(str, args))}"
    if origin is tuple:
        many = Ellipsis in args
        if not isinstance(value, tuple) or not (many or len(value) == len(args)):
            return f"a list of {len(args)}" if isinstance(value, tuple) else "a list"
        for i, one in enumerate(value):
            _check(one, args[0 if many else i], f"{name}[{i}]")
        return ""
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, typing.cast(type, hint)):
            return "settings {...}"
        check_settings(value, name)
        return ""
    return "" if hint not in WORDS or isinstance(value, hint) else WORDS[hint]


def read_settings(hint: Any, tree: Any, name: str) -> Any:  # noqa: ANN401
    """Settings of this type from plain JSON values, checked before a record is built of them.

    What is missing keeps its default.

    Raises:
        InputError: If one is unknown, of a wrong type, or out of its range.
    """
    args = get_args(hint)
    kinds = [one for one in (args if get_origin(hint) in UNIONS else (hint,))
             if isinstance(one, type) and dataclasses.is_dataclass(one)]  # fmt: skip
    if kinds and isinstance(tree, Mapping):
        kind = next((k for k in kinds if set(settings_of(k)) == set(tree)), kinds[0])
        fields = settings_of(kind)
        for key in tree:
            if key not in fields:
                known = ", ".join(fields)
                raise InputError(f"{_joined(name, key)}: is no setting, expected one of {known}")
        return kind(**{k: read_settings(fields[k], v, _joined(name, k)) for k, v in tree.items()})
    if isinstance(tree, list):
        items = args[:1] * len(tree) if Ellipsis in args else (*args, *[Any] * len(tree))
        pairs = enumerate(zip(items, tree, strict=False))
        tree = tuple(read_settings(kind, one, f"{name}[{i}]") for i, (kind, one) in pairs)
    _check(tree, hint, name)
    return tree
