"""Lists of people by image, as tools that see one image at a time leave them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...records import InputError
from ..fields import At, refuse
from .files import KINDS, natural, read_any


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
