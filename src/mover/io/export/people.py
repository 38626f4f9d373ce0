"""The people of a result, one after the other: the rows of their frames, and key frames."""

import heapq

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import Bodies

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
    """All people, by the number of their track."""
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


# Fewer key frames for a moving mesh, so that straight lines between them stay near the truth.


WATCHED = 300  # vertices that are compared, evenly chosen


def keyframes(
    verts: Float[Tensor, "frames verts 3"],
    time: Float[Tensor, " frames"],
    tolerance: float,
    most: int,
) -> tuple[list[int], float]:
    """Indices of key frames, the first and the last among them, and the largest miss between them.

    The worst frame between two key frames becomes one, until none misses by more than `tolerance`
    or there are `most` [m].
    """
    if len(verts) <= 2:
        return list(range(len(verts))), 0.0
    step = max(1, verts.shape[1] // WATCHED)
    seen, when = verts[:, ::step].double(), time.double()
    chosen = {0, len(verts) - 1}
    heap = [_worst(seen, when, 0, len(verts) - 1)]
    while heap and -heap[0][0] > tolerance and len(chosen) < most:
        _, middle, first, last = heapq.heappop(heap)
        chosen.add(middle)
        for a, b in ((first, middle), (middle, last)):
            if b > a + 1:
                heapq.heappush(heap, _worst(seen, when, a, b))
    return sorted(chosen), -heap[0][0] if heap else 0.0


def _worst(
    verts: Float[Tensor, "frames verts 3"], time: Float[Tensor, " frames"], first: int, last: int
) -> tuple[float, int, int, int]:
    """The frame that a line from `first` to `last` misses most, and its miss, negative [m]."""
    inner = slice(first + 1, last)
    share = ((time[inner] - time[first]) / (time[last] - time[first]))[:, None, None]
    line = verts[first] + share * (verts[last] - verts[first])
    miss = (line - verts[inner]).norm(dim=-1).amax(-1)
    worst = int(miss.argmax())
    return -float(miss[worst]), first + 1 + worst, first, last
