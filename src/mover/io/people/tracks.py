"""Who is who: people that a file names, and people that must be followed from frame to frame."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.io.files.fields import At, mapping, refuse
from mover.io.people.found import Found, Known, joined
from mover.io.people.values import KINDS, natural, read_any

PATIENCE = 15  # a person who is gone for so many frames starts a new track
REACH = 0.6  # of a person's size: how far one may move from frame to frame
TALL = 1.7  # [m], the size of a person whose file does not tell it
GROWTH = 0.25  # `REACH` grows by this share with each frame of a gap


def people_of(at: At) -> list[tuple[int, At]]:
    """The people of a mapping from track to person, numbered by their keys or in order.

    Raises:
        InputError: If it is no mapping of mappings, or is empty.
    """
    given = mapping(at)
    if not given:
        raise InputError(f"{at.place} has no people, expected at least one track")
    keys = [str(key) for key in given]
    numbered = all(key.isdigit() for key in keys)
    people: list[tuple[int, At]] = []
    for index, (key, value) in enumerate(given.items()):
        field = f"{at.field}.{key}" if at.field else str(key)
        people.append((int(keys[index]) if numbered else index, At(value, at.file, field)))
    for _, person in people:
        mapping(person)
    return people


def followed(
    frames: Sequence[int], places: NDArray[np.float64], sizes: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Tracks of people that each frame lists in any order.

    The nearest pair of a track and a person is joined first; nobody moves further than `REACH`
    of the larger of the two sizes, and a little more after a gap.

    Args:
        frames: Frame of each row.
        places: (rows, axes), where each is, in any unit.
        sizes: (rows,), how large each is, in the same unit.
    """
    tracks = np.full(len(frames), -1, dtype=np.int64)
    last: dict[int, int] = {}
    order = np.asarray(frames)
    for frame in sorted(set(order.tolist())):
        here = np.flatnonzero(order == frame)
        alive = {t: row for t, row in last.items() if frame - order[row] <= PATIENCE}
        for track, row in _pairs(alive, here, order, places, sizes):
            tracks[row] = track
        for row in here:
            if tracks[row] < 0:
                tracks[row] = len(last)
            last[int(tracks[row])] = int(row)
    return tracks


def _pairs(
    alive: dict[int, int],
    here: NDArray[np.int64],
    frames: NDArray[np.int64],
    places: NDArray[np.float64],
    sizes: NDArray[np.float64],
) -> list[tuple[int, int]]:
    """Tracks and rows that belong together, nearest first."""
    options: list[tuple[float, int, int]] = []
    for track, before in alive.items():
        for row in here:
            gap = int(frames[row] - frames[before])
            size = max(sizes[row], sizes[before], 1e-9)
            way = float(np.linalg.norm(places[row] - places[before]) / size)
            if way <= REACH * (1 + GROWTH * (gap - 1)):
                options.append((way, track, int(row)))
    found: list[tuple[int, int]] = []
    for _, track, row in sorted(options):
        if all(track != t and row != r for t, r in found):
            found.append((track, row))
    return found


# Lists of people by image, as tools that see one image at a time leave them.


def tracked(
    path: Path, known: Known, place: Callable[[At], Any], body: Callable[["Sighting", int], Found]
) -> Found:
    """People of all images, followed from image to image by the places of their bodies.

    Raises:
        InputError: If there is nobody, or a person is not as the tool writes one.
    """
    seen = sightings(path, known.first)
    if not seen:
        raise InputError(f"{path}: has no people, expected at least one")
    places = np.stack([place(s.at) for s in seen])
    who = followed([s.frame for s in seen], places, np.full(len(seen), TALL))
    return joined([body(s, int(track)) for s, track in zip(seen, who, strict=True)])


@dataclass(frozen=True)
class Sighting:
    """One person in one image."""

    frame: int
    at: At


def sightings(path: Path, first: int) -> list[Sighting]:
    """All people of a file, or of a folder with a file an image or a file a person.

    Raises:
        InputError: If a file cannot be read or lists no people.
    """
    if path.is_dir():
        files = sorted((f for f in path.iterdir() if f.suffix.lower() in KINDS), key=natural)
    else:
        files = [path]
    if not files:
        raise InputError(f"{path}: has no files of kind {', '.join(KINDS)}")
    numbers = _frames([file.stem for file in files])
    found: list[Sighting] = []
    for file, number in zip(files, numbers, strict=True):
        found += _of_file(read_any(file), number - first if path.is_dir() else 0)
    return found


def _frames(stems: list[str]) -> list[int]:
    """Frame of each file: what is left of its name without the person.

    Names that end in `_subj00` or `_person1` are people of the image before; then the last number
    of what is left counts, else the order.
    """
    images = [re.sub(r"_?(?:subj|person|human)_?\d+$", "", stem) for stem in stems]
    digits = [re.findall(r"\d+", image) for image in images]
    if all(digits):
        found = [int(d[-1]) for d in digits]
        if len(set(zip(found, images, strict=True))) == len(set(found)):
            return found
    order = {image: k for k, image in enumerate(dict.fromkeys(images))}
    return [order[image] for image in images]


def _of_file(at: At, frame: int) -> list[Sighting]:
    """The people of one file: a person, a list of people, or lists by image."""
    value = at.value
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, Mapping):
        return _of_mapping(At(value, at.file, at.field), frame)
    if not isinstance(value, list | tuple):
        refuse(at, "a person, or a list of people")
    found: list[Sighting] = []
    for k, each in enumerate(value):
        field = f"{at.field}[{k}]"
        if isinstance(each, list | tuple):  # one list for each image
            found += _of_file(At(list(each), at.file, field), frame + k)
        else:
            found.append(Sighting(frame, At(each, at.file, field)))
    return found


def _of_mapping(at: At, frame: int) -> list[Sighting]:
    """One person, or lists of people by image number."""
    given: Mapping[Any, Any] = at.value
    if given and all(_is_people(v) for v in given.values()):
        keys = [re.findall(r"\d+", str(key)) for key in given]
        numbers = [int(k[-1]) for k in keys] if all(keys) else list(range(len(given)))
        found: list[Sighting] = []
        for number, (key, value) in zip(numbers, given.items(), strict=True):
            found += _of_file(At(list(value), at.file, str(key)), number)
        return found
    for name in ("humans", "people", "outputs"):
        if name in given:
            return _of_file(At(given[name], at.file, name), frame)
    return [Sighting(frame, at)]


def _is_people(value: Any) -> bool:  # noqa: ANN401
    """Whether a value is a list of people, which may be empty."""
    return isinstance(value, list | tuple) and all(isinstance(v, Mapping) for v in value)
