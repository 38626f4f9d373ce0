"""The people of a result, one after the other, each with the rows of their frames in order."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..records import record
from ..types import Bodies

FPS = 5.0  # of images that have no time: so many a second
GAP = 1.0  # [s]; a person who is not seen for longer is hidden meanwhile


@record
class Track:
    """One person."""

    person: int
    rows: Int[Tensor, " rows"]
    """Rows of the bodies, by frame."""
    frame: Int[Tensor, " rows"]
    time: Float[Tensor, " rows"]
    """Since the first frame of the file [s]."""
    last: float
    """Time of the last frame of the file [s]."""


def tracks_of(bodies: Bodies) -> list[Track]:
    """Everybody, by the number of their track."""
    fps = bodies.fps or FPS
    begin = int(bodies.frame.min())
    last = (int(bodies.frame.max()) - begin) / fps
    found: list[Track] = []
    for person in bodies.person.unique().tolist():
        rows = (bodies.person == person).nonzero()[:, 0]
        rows = rows[torch.argsort(bodies.frame[rows])]
        frame = bodies.frame[rows]
        found.append(Track(person, rows, frame, (frame - begin).double() / fps, last))
    return found


def seen_from_to(track: Track) -> list[tuple[float, float]]:
    """Spans of time in which the person is seen [s]."""
    breaks = (track.time.diff() > GAP).nonzero()[:, 0].tolist()
    starts, ends = [0, *(b + 1 for b in breaks)], [*breaks, len(track.time) - 1]
    return [(float(track.time[a]), float(track.time[b])) for a, b in zip(starts, ends, strict=True)]
