"""Ways around the furniture: cheapest paths on a grid that keep away from footprints."""

import numpy as np
from jaxtyping import Bool, Float

from .placed import Placed, free_of
from .steps import Floor

CELL = 0.06  # [m]
BODY = 0.28  # [m], nearer than this to furniture nobody walks
ROOMY = 0.42  # [m], nearer than this one walks only where one must
DEAR = 6.0  # cost of a metre in between


class NoWayError(Exception):
    """There is no free path."""


def way(
    start: Float[np.ndarray, "2"],
    goal: Float[np.ndarray, "2"],
    pieces: tuple[Placed, ...],
    bounds: Float[np.ndarray, "2 2"],
    apart: float = 0.0,
) -> Floor:
    """Points (x, z) from start to goal, both included [m].

    Args:
        start: Where the walk begins.
        goal: Where it ends.
        pieces: Furniture to walk around.
        bounds: Smallest and largest x and z that one may walk.
        apart: How much farther from furniture than usual [m].

    Raises:
        NoWayError: If furniture closes the way.
    """
    from scipy.sparse.csgraph import dijkstra

    shape = np.ceil((bounds[1] - bounds[0]) / CELL).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    points = bounds[0] + CELL * grid
    cost = np.where(free_of(points, pieces, ROOMY + apart), 1.0, DEAR)
    open_ = free_of(points, pieces, BODY + apart)
    index = [_nearest(points, open_, end) for end in (start, goal)]
    _, before = dijkstra(_graph(open_, cost), indices=index[0], return_predecessors=True)
    cells = [index[1]]
    while cells[-1] != index[0]:
        cells.append(int(before[cells[-1]]))
        if cells[-1] < 0:
            raise NoWayError(f"no way from {start.round(2).tolist()} to {goal.round(2).tolist()}")
    middle = points.reshape(-1, 2)[cells[::-1]]
    return _straightened(np.concatenate([start[None], middle, goal[None]]), pieces, apart)


def _nearest(points: np.ndarray, open_: Bool[np.ndarray, "x z"], end: np.ndarray) -> int:
    far = np.where(open_, np.linalg.norm(points - end, axis=-1), np.inf)
    if far.min() > 0.3:
        raise NoWayError(f"{end.round(2).tolist()} is not free")
    return int(far.argmin())


def _graph(open_: Bool[np.ndarray, "x z"], cost: Float[np.ndarray, "x z"]) -> object:
    """Sparse graph of the eight neighbours of each open cell."""
    from scipy.sparse import coo_matrix

    number = np.arange(open_.size).reshape(open_.shape)
    rows, cols, prices = [], [], []
    for dx, dz in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = (slice(0, -dx or None), slice(max(0, -dz), -dz if dz > 0 else None))
        b = (slice(dx, None), slice(max(0, dz), dz if dz < 0 else None))
        both = open_[a] & open_[b]
        rows.append(number[a][both])
        cols.append(number[b][both])
        prices.append(np.hypot(dx, dz) * CELL * (cost[a][both] + cost[b][both]) / 2)
    parts = tuple(np.concatenate(p) for p in (rows, cols, prices))
    one_way = coo_matrix((parts[2], (parts[0], parts[1])), shape=(open_.size, open_.size))
    return (one_way + one_way.T).tocsr()


def _straightened(path: Floor, pieces: tuple[Placed, ...], apart: float) -> Floor:
    """Leave out corners where the straight line is not dearer than the way around."""
    ends = np.cumsum(_prices(path[:-1], path[1:], pieces, apart))
    cumulative = np.concatenate([[0.0], ends])
    kept, at = [0], 0
    while at < len(path) - 1:
        later = np.arange(len(path) - 1, at, -1)
        price = _prices(np.repeat(path[at][None], len(later), 0), path[later], pieces, apart)
        cheap = price <= 1.01 * (cumulative[later] - cumulative[at]) + 1e-9
        at = int(later[np.flatnonzero(cheap)[0]]) if cheap.any() else at + 1
        kept.append(at)
    return path[kept]


def _prices(
    start: Floor, end: Floor, pieces: tuple[Placed, ...], apart: float
) -> Float[np.ndarray, " lines"]:
    """Cost of straight lines; infinite where a line is blocked in its middle."""
    share = np.linspace(0, 1, 24)[:, None, None]
    points = start + share * (end - start)
    length = np.linalg.norm(end - start, axis=-1)
    near = np.where(free_of(points, pieces, ROOMY + apart), 1.0, DEAR)
    inner = np.linalg.norm(points - start, axis=-1) > 0.3
    inner &= np.linalg.norm(points - end, axis=-1) > 0.3
    blocked = (~free_of(points, pieces, BODY + apart) & inner).any(0)
    return np.where(blocked, np.inf, length * near.mean(0))
