"""Who is who: people that a file names, and people that must be followed from frame to frame."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.io.files.fields import At, mapping

PATIENCE = 15  # a person who is gone for so many frames starts a new track
REACH = 0.6  # of a person's size: how far one may move from frame to frame
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
