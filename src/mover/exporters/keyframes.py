"""Fewer key frames for a moving mesh, so that straight lines between them stay near the truth."""

import heapq

from jaxtyping import Float
from torch import Tensor

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
