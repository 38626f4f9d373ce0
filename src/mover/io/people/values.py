"""Files of other tools as plain values: fields under any of their names, NaN let through."""

import logging
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import PICKLES
from mover.core.pickles import load_plain
from mover.io.files.fields import (
    AMASS,
    LARGEST,
    LAST_INDEX,
    At,
    existing,
    is_amass,
    read_json,
    read_npy,
    read_npz,
)
from mover.io.people.found import Known

log = logging.getLogger(__name__)

TREES = {".npz": read_npz, ".json": read_json}
KINDS = (".npz", ".npy", *PICKLES, ".json")
SHOWN_KEYS = 24
LEAST_TURN = 0.05  # an array of matrices whose rows are not unit vectors within this is none


def named(path: Path) -> Path:
    """A path that has a name for messages, as `.` has not."""
    return path if path.name not in ("", "..") else path.resolve()


def read_any(path: Path) -> At:
    """The content of a file, read without running anything in it."""
    kind = existing(path).suffix.lower()
    if kind not in KINDS:
        raise InputError(f"{path.name}: is no file of kind {', '.join(KINDS)}")
    if kind in TREES:
        return TREES[kind](path)
    if kind == ".npy":
        with path.open("rb") as file:
            plain = b"'|O'" not in file.readline(1000)  # of the header: a pickled object
        if plain:
            return read_npy(path)
    return At(load_plain(path), path.name)


def files_of(path: Path, what: str, *patterns: str) -> list[Path]:
    """The file itself, or those of a folder that fit the first pattern that any fits, 2 before 10.

    Raises:
        InputError: If a folder has none, `what` was expected.
    """
    if not path.is_dir():
        return [path]
    for pattern in patterns:
        if files := sorted(path.glob(pattern), key=natural):
            return files
    raise InputError(f"{path}: has no {' or '.join(patterns).replace('**/', '')}, expected {what}")


def only_file(path: Path, what: str, *patterns: str) -> Path:
    """The file itself, or the only one of a folder."""
    files = files_of(path, what, *patterns)
    if len(files) > 1:
        raise InputError(f"{path}: has {len(files)} files {patterns[0]}, expected one: name it")
    return files[0]


def read_one(path: Path, what: str, *patterns: str) -> At:
    """The content of the file itself, or of the only one of a folder, which is not AMASS's."""
    at = read_any(only_file(path, what, *patterns))
    if isinstance(at.value, Mapping) and is_amass(at):
        raise InputError(f"{at.file}: is {AMASS}")
    return at


def number_in(name: str, index: int) -> int:
    """The last number in a file's name, else its rank among the files."""
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else index


def frame_numbers(names: Iterable[str], place: str) -> dict[str, int]:
    """Frames by the names (no endings) of their files, as `s001_frame_00012__00.00.00.401`.

    The number after `frame` counts, else the last one. Where the names show several shots (s001,
    s002, ...), each is a still of its own, and they are numbered from 1 in their order. Messages
    call the recording `place`.

    Raises:
        InputError: If two names would be one frame.
    """
    known = sorted(set(names), key=lambda name: natural(Path(name)))
    shots = {found[1] for name in known if (found := re.match(r"s(\d+)_frame", name))}
    if len(shots) > 1:
        return {name: rank for rank, name in enumerate(known, 1)}
    frames, owners = dict[str, int](), dict[int, str]()
    for rank, name in enumerate(known):
        named = re.findall(r"frame_?(\d+)", name)
        frames[name] = number = number_in(named[-1] if named else name, rank)
        if owners.setdefault(number, name) != name:
            raise InputError(f"{place}: {owners[number]} and {name} are both frame {number}")
    return frames


def frames_in(images: Sequence[Path], path: Path, known: Known) -> list[int]:
    """Frames by the names of the files or folders of images below `path`; one file is frame 0.

    Raises:
        InputError: If two names would be one frame, or one is none of the frames that are known.
    """
    if not path.is_dir():
        return [0 for _ in images]
    names = [image.stem if image.suffix.lower() in KINDS else image.name for image in images]
    frames = known.frames
    if frames is None:
        numbered = frame_numbers(names, path.name)
        frames = {name: number - known.first for name, number in numbered.items()}
        bare = [name for name in frames if not re.search(r"\d", name)]
        if bare and len(frames) > 1:
            ranks = ", ".join(f"{name} = {frames[name]}" for name in bare[:4])
            log.warning("%s: names without a number are frames by rank: %s", path.name, ranks)
    if unknown := [image for image, name in zip(images, names, strict=True) if name not in frames]:
        raise InputError(f"{unknown[0]}: is no frame of the recording")
    return [frames[name] for name in names]


def natural(path: Path) -> tuple[tuple[int, str], ...]:
    """A key that sorts numbers in names by value: 2 before 10."""
    parts = re.split(r"(\d+)", str(path))
    return tuple((int(p), "") if p.isdigit() else (-1, p) for p in parts)


def need(at: At, *names: str) -> At:
    """The first of several names of a field that is there."""
    found = at.maybe(*names)
    if found is None:
        place = f"{at.place}: " if at.field else f"{at.file}: "
        wanted = " or ".join(f"'{name}'" for name in names)
        keys = [f"'{key}'" for key in at.mapping()]
        more = f" and {len(keys) - SHOWN_KEYS} more" if len(keys) > SHOWN_KEYS else ""
        known = (", ".join(keys[:SHOWN_KEYS]) or "none") + more
        if is_amass(at):
            known += f"; this is {AMASS}"
        raise InputError(f"{place}there is no key {wanted}, found {known}")
    return found


def people_of(at: At) -> list[tuple[int, At]]:
    """The people of a list, or of a mapping from track to person, by their keys or in order."""
    if isinstance(at.value, list | tuple):
        at = at.holding({str(number): one for number, one in enumerate(at.value)})
    keys = list(at.mapping())
    if not keys:
        raise InputError(f"{at.place} has no people, expected at least one track")
    tracks = [number_in(key, index) for index, key in enumerate(keys)]  # 17 of 17, of person_17
    tracks = tracks if len(set(tracks)) == len(keys) else range(len(keys))
    people = [(track, at.get(key)) for track, key in zip(tracks, keys, strict=True)]
    for _, person in people:
        if not isinstance(person.value, Mapping):
            person.refuse("the fields of a person under the number of a track")
    return people


def with_fields(at: At, **more: Any) -> At:  # noqa: ANN401
    """A mapping with more fields."""
    return at.holding({**at.mapping(), **more})


def lone(at: At) -> Any:  # noqa: ANN401
    """The value itself, taken out of arrays and lists of one."""
    value: Any = at.value.tolist() if isinstance(at.value, np.ndarray) else at.value
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    return value


def numbers(at: At) -> NDArray[np.float64]:
    """An array of real numbers of any shape; NaN and infinity are let through."""
    try:
        value = np.asarray(at.value)
    except ValueError:  # lists of different lengths
        at.refuse("an array of numbers", "lists of different lengths")
    if value.dtype.kind not in "fiub":
        at.refuse("an array of numbers")
    return value.astype(np.float64)


def rows(at: At, count: int | None, *widths: int) -> NDArray[np.float64]:
    """An array with `count` rows (any number: None), flattened to one of the widths (none: any).

    One row may stand for all.
    """
    value = numbers(at)
    if value.ndim > 2 and len(value) == 1 and count not in (None, 1):
        value = value[0]  # a batch of one
    if (value.ndim == 1 and not widths) or (value.size in widths and 1 in (value.ndim, count)):
        value = value.reshape(1, -1)
    flat = value.reshape(len(value), -1) if value.size and value.ndim else np.zeros((0, 0))
    fits = flat.size > 0 and (flat.shape[1] in widths or not widths)
    if not fits or (count is not None and len(flat) not in (count, 1)):
        width = " or ".join(map(str, widths)) or "any"
        shape = f"({'n' if count is None else count}, {width})"
        at.refuse(f"numbers that give {shape}", f"shape {numbers(at).shape}")
    return flat if count is None else np.broadcast_to(flat, (count, flat.shape[1]))


def stacked(at: At, *tail: int) -> NDArray[np.float64]:
    """An array of any number of items of this shape."""
    value = numbers(at)
    if not value.size or value.size % math.prod(tail):
        shape = ", ".join(map(str, ("n", *tail)))
        at.refuse(f"numbers that give ({shape})", f"shape {value.shape}")
    return value.reshape(-1, *tail)


def one_number(at: At) -> float:
    """The first number of an array, finite."""
    value = float(stacked(at, 1)[0, 0])
    if not abs(value) <= LARGEST:
        at.refuse("a finite number", f"{value}")
    return value


def whole(at: At) -> NDArray[np.int64]:
    """Whole numbers along one axis."""
    value = numbers(at).reshape(-1)
    if not (np.abs(value) <= LAST_INDEX).all() or (value != np.round(value)).any():
        at.refuse(f"whole numbers up to {LAST_INDEX}")
    return value.astype(np.int64)


def angles(at: At, count: int | None, *joints: int) -> Float[Tensor, "rows angles"]:
    """Axis-angle vectors of so many joints, given as such or as rotation matrices [rad]."""
    flat = rows(at, count, *[j * 3 for j in joints], *[j * 9 for j in joints])
    if flat.shape[1] in [j * 3 for j in joints]:
        return tensor(flat)
    return tensor(vectors(flat.reshape(len(flat), -1, 3, 3), at))


def vectors(matrices: NDArray[np.float64], at: At) -> NDArray[np.float64]:
    """Axis-angle vectors of rotation matrices; NaN stays NaN."""
    from scipy.spatial.transform import Rotation

    known: NDArray[np.bool_] = np.asarray(np.isfinite(matrices).all((-1, -2)))
    safe = np.where(known[..., None, None], matrices, np.eye(3))
    off = np.abs(safe @ np.swapaxes(safe, -1, -2) - np.eye(3)).max(initial=0.0)
    if off > LEAST_TURN or (np.linalg.det(safe) < 0).any():
        at.refuse("rotation matrices (orthonormal, determinant +1)", "matrices that are none")
    found = Rotation.from_matrix(safe.reshape(-1, 3, 3)).as_rotvec().reshape(*known.shape, 3)
    return np.where(known[..., None], found, np.nan).reshape(len(matrices), -1)


def tensor(value: NDArray[Any]) -> Float[Tensor, "*shape"]:
    """Numbers as the package keeps them."""
    return torch.from_numpy(np.ascontiguousarray(value, dtype=np.float32))
