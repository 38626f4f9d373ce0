"""Values from a user's file that know their place, and the checks that every reader shares.

Of JSON and .npz files that others made no pickles are read, and no bombs; the same arrays are
written as the same bytes.
"""

import json
import logging
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn

import msgspec
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.files import BROKEN, not_there, reason, replacing, unreadable

log = logging.getLogger(__name__)
Warn = Callable[[str], None]
"""Takes a warning; readers of whole captures collect them."""

LARGEST_FILE = 4 << 30  # [bytes], of a JSON file or of all arrays of an .npz
LARGEST = 1e9  # no number of the format is larger; keeps float32 finite
LAST_INDEX = 10_000_000  # frames, tracks
LAST_ID = 1 << 62
SLOWEST, FASTEST = 1e-3, 1e4  # frames a second


MISSING = object()
"""The value of a field that is not there."""


@dataclass(frozen=True)
class At:
    """A value of the user and where it stands; what is asked of it is checked."""

    value: Any
    file: str
    field: str = ""

    @property
    def place(self) -> str:
        """How an error message calls it."""
        return f"{self.file}: field '{self.field}'" if self.field else self.file

    def refuse(self, expected: str, found: str | None = None) -> NoReturn:
        """Raise the error that names file, field, found and expected."""
        raise InputError(f"{self.place} has {found or shown(self.value)}, expected {expected}")

    def holding(self, value: Any) -> "At":  # noqa: ANN401
        """Another value in the same place."""
        return At(value, self.file, self.field)

    def get(self, key: str) -> "At":
        """The field `key` of a mapping; its value is MISSING where it has none."""
        value = self.mapping().get(key, MISSING)
        return At(value, self.file, f"{self.field}.{key}" if self.field else key)

    def maybe(self, *keys: str) -> "At | None":
        """The first of several names of a field that is there and not null, None without."""
        given = self.mapping()
        return next((self.get(key) for key in keys if given.get(key) is not None), None)

    def mapping(self) -> Mapping[str, Any]:
        """A JSON object."""
        if not isinstance(self.value, Mapping):
            self.refuse("an object {...}")
        return self.value

    def items(self, count: int | None = None) -> "list[At]":
        """The items of a list, of `count` of them if given."""
        expected = "a list" if count is None else f"a list of {count}"
        if not isinstance(self.value, list | tuple):
            self.refuse(expected)
        if count is not None and len(self.value) != count:
            self.refuse(expected, f"{len(self.value)} items")
        return [At(v, self.file, f"{self.field}[{i}]") for i, v in enumerate(self.value)]

    def text(self) -> str:
        """Printable text that is not blank."""
        value = self.value
        if not isinstance(value, str) or not value.strip() or not value.isprintable():
            self.refuse("printable text")
        return value

    def choice(self, choices: tuple[str, ...]) -> str:
        """One of `choices`."""
        if not isinstance(self.value, str) or self.value not in choices:
            self.refuse("one of " + ", ".join(choices))
        return self.value

    def number(self, low: float = -LARGEST, high: float = LARGEST, expected: str = "") -> float:
        """A finite number between the bounds, which messages call as `expected`."""
        bounds = "" if (low, high) == (-LARGEST, LARGEST) else f" from {low:g} to {high:g}"
        value = self.value
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not low <= value <= high:  # false for NaN as well
            self.refuse(expected or f"a finite number{bounds}")
        return float(value)

    def integer(self, low: int = 0, high: int = LAST_INDEX) -> int:
        """A whole number between the bounds."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.refuse(f"a whole number from {low} to {high}")
        return value

    def indices(self, count: int | str) -> NDArray[np.int64]:
        """An array of so many frames or tracks."""
        value = self.array((count,), "whole")
        bad = (value < 0) | (value > LAST_INDEX)
        if bad.any():
            self.refuse(f"whole numbers from 0 to {LAST_INDEX}", f"{value[bad][0]}")
        return value.astype(np.int64)

    def vector(self, count: int) -> list[float]:
        """A list of `count` finite numbers."""
        return [item.number() for item in self.items(count)]

    def array(
        self, shape: tuple[int | str, ...], kind: Literal["real", "whole", "text"] = "real"
    ) -> NDArray[Any]:
        """An array of this shape, where a letter stands for any size, with finite values."""
        value = self.value
        wanted = f"{kind} numbers" if kind != "text" else "text"
        expected = f"an array of {wanted} of shape ({', '.join(map(str, shape))})"
        if not isinstance(value, np.ndarray) or value.dtype.kind not in _KINDS[kind]:
            self.refuse(expected)
        fits = all(isinstance(n, str) or n == m for n, m in zip(shape, value.shape, strict=False))
        if value.ndim != len(shape) or not fits:
            self.refuse(expected)
        if kind == "real":
            with np.errstate(invalid="ignore"):
                bad = ~(np.abs(value.astype(np.float64, copy=False)) <= LARGEST)
            if bad.any():
                first = tuple(int(i) for i in np.argwhere(bad)[0])
                self.refuse("finite numbers", f"{value[first]} at {list(first)}")
        return value


_KINDS = {"real": "fiu", "whole": "iu", "text": "U"}


def shown(value: Any) -> str:  # noqa: ANN401
    """A short picture of any value for a message."""
    if value is MISSING:
        return "nothing"
    if isinstance(value, np.ndarray):
        return f"shape {value.shape} of {value.dtype}"
    if isinstance(value, Mapping) and value:
        return f"an object of {', '.join(map(str, value))[:60]}"
    if isinstance(value, int) and abs(value) > 10**18:
        return "a huge number"
    text = json.dumps(value) if isinstance(value, str) else repr(value)
    return text if len(text) <= 60 else f"{text[:56]} ..."


def listed(what: str, names: Sequence[object]) -> str:
    """`3 chairs (1, 2, 3)` for a warning about many."""
    some = ", ".join(map(str, names[:6])) + (", ..." if len(names) > 6 else "")
    return f"{what} {some}" if len(names) == 1 else f"{len(names)} {what}s ({some})"


def unique(at: At, seen: set[Any], key: object, what: str) -> None:
    """Refuse a key that was seen before, and remember it."""
    if key in seen:
        at.refuse(f"{what} that is not used twice")
    seen.add(key)


def existing(path: Path, expected: str = "") -> Path:
    """The path of a file that is there and not too large."""
    name, more = path.name or path.resolve().name, f", expected {expected}" if expected else ""
    if not path.is_file():
        inner = path.parent / "room" / name  # of OUT of `mover video`
        more = f", but in {inner.parent}" if inner.is_file() else more
        raise InputError(
            f"{name}: {not_there(path, f'there is no such file in {path.parent}')}{more}"
        )
    if (size := path.stat().st_size) > LARGEST_FILE:
        raise InputError(f"{name}: has {size} bytes, expected at most {LARGEST_FILE}")
    return path


def read_json(path: Path) -> At:
    """The content of a JSON file."""
    name = existing(path, "a JSON file").name
    try:
        text = path.read_text(encoding="utf-8-sig")
        return At(json.loads(text, object_pairs_hook=_once), name)
    except (ValueError, RecursionError, OSError) as error:
        why = reason(error, path)
        raise InputError(f"{name}: is not JSON ({why}), expected a JSON file") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON whose names are all different."""
    tree = dict(pairs)
    if len(tree) < len(pairs):
        known: set[str] = set()
        twice = next(key for key, _ in pairs if key in known or known.add(key))
        raise ValueError(f"the name {shown(twice)} is there twice")
    return tree


def write_json(value: object, path: Path) -> None:
    """Write JSON in one step, always the same bytes for the same value."""
    body = json.dumps(value, allow_nan=False, ensure_ascii=False)
    with replacing(path) as part:
        part.write_text(msgspec.json.format(body, indent=1) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:  # noqa: ANN401
    """A tensor as nested lists of the shortest decimals that read back the same."""
    if value.ndim:
        return [plain(v) for v in value]
    return float(str(np.asarray(value.detach().cpu())))


class NotPlain:
    """Stands for an array of Python's objects or of fields, which is refused where it is needed."""

    def __repr__(self) -> str:
        return "no plain numbers (no pickled objects are read)"


AMASS = (
    "a motion of AMASS, in a world of its own and not in a camera: --bodies-from amass, or `mover "
    "import-bodies amass`, reads it upright, but where people are in the picture it does not say"
)


def is_amass(at: At) -> bool:
    """Whether these are the arrays of a motion."""
    keys = at.mapping().keys()
    other = not keys.isdisjoint(("frame", "cam_R"))  # bodies.npz, a result of SLAHMR
    return "trans" in keys and not other and not keys.isdisjoint(("poses", "pose_body"))


def read_npz(path: Path, most: int = LARGEST_FILE) -> At:
    """The arrays of an .npz file by name, of `most` bytes; odd ones are `NotPlain`."""
    name = existing(path, "an .npz file").name or path.resolve().name
    try:
        odd = _odd_arrays(path, most)
        with np.load(path, allow_pickle=False) as arrays:
            return At({key: odd.get(key) or arrays[key] for key in arrays.files}, name)
    except BROKEN as error:
        raise unreadable(path, error, "an .npz file") from error


def _odd_arrays(path: Path, most: int) -> dict[str, NotPlain]:
    """Arrays that are not plain; sizes that are promised are checked before any is unpacked."""
    total, odd = 0, dict[str, NotPlain]()
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            if not entry.filename.endswith(".npy"):
                raise ValueError(f"it is a zip archive with {entry.filename}")
            with archive.open(entry) as stream:
                dtype, size = _header(stream)
            total += size
            key = entry.filename.removesuffix(".npy")
            if dtype.hasobject or dtype.fields:
                odd[key] = NotPlain()
            if total > most:
                found = f"has {total} bytes or more, expected at most {most} in the file"
                raise InputError(f"{path.name}: field '{key}' {found}")
    return odd


def _header(stream: Any) -> tuple[np.dtype[Any], int]:  # noqa: ANN401
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    version = npy.read_magic(stream)
    if version not in read:
        raise ValueError(f"version {version} of the .npy format")
    shape, _, dtype = read[version](stream)
    if any(n < 0 for n in shape):
        raise ValueError(f"an array of shape {shape}")
    return dtype, dtype.itemsize * math.prod(shape)


def read_npy(path: Path) -> At:
    """The array of an .npy file.

    Raises:
        InputError: If it is missing, broken, promises more than it has or holds pickled objects.
    """
    existing(path, "an .npy file")
    try:
        with path.open("rb") as file:
            dtype, size = _header(file)
            if dtype.hasobject or dtype.fields:
                found = f"has {dtype}, expected plain numbers (no pickled objects)"
                raise InputError(f"{path.name}: {found}")
            if size > path.stat().st_size:
                found = f"promises {size} bytes, expected no more than it has"
                raise InputError(f"{path.name}: {found}")
            file.seek(0)
            return At(np.load(file, allow_pickle=False), path.name)
    except BROKEN as error:
        raise unreadable(path, error, "an .npy file") from error


def write_npz(arrays: Mapping[str, NDArray[Any]], path: Path) -> None:
    """Write arrays in one step, always the same bytes for the same arrays."""
    with replacing(path) as part:
        np.savez(part, allow_pickle=False, **dict(arrays))
