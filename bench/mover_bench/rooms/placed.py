"""Furniture in a room: places on the floor, depth of bodies inside it, ways around it."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.furniture.pieces import Furniture
from mover_bench.rooms.gait import Floor
from mover_bench.rooms.poses import facing, left_of

SIGNS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # of the corners of a footprint
FAR = 0.03  # [m], signed distances beyond this are not distinguished


@record
class Placed:
    """A piece in a room (+y up, the floor at y = 0)."""

    id: str
    furniture: Furniture
    at: tuple[float, float]  #: x and z of the centre of the base [m]
    heading: float  #: rotation about +y; 0 faces +z, towards the camera [rad]

    @property
    def place(self) -> Float[np.ndarray, "2"]:
        """X and z of the centre of the base [m]."""
        return np.array(self.at)

    @property
    def axes(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """Directions on the floor (x, z) to the left of the piece and to its front."""
        return left_of(np.array(self.heading)), facing(np.array(self.heading))


@record
class Spot:
    """An edge that one can sit on."""

    edge: Float[np.ndarray, "2"]  #: a point on the front edge of the seat (x, z) [m]
    heading: float  #: where the sitter looks [rad]
    height: float  #: [m]
    depth: float  #: from the edge to the backrest, or to the far edge [m]
    lip: float  #: how far the base stands out under the edge [m]


def on_floor(piece: Placed, x: float, z: float) -> Float[np.ndarray, "2"]:
    """Place on the floor (x, z) of a point in the axes of the piece [m]."""
    left, front = piece.axes
    return piece.place + x * left + z * front


def corners(piece: Placed, margin: float = 0.0) -> Float[np.ndarray, "4 2"]:
    """Corners of the footprint of a piece, grown by `margin` [m]."""
    w, _, d = piece.furniture.size
    x, z = w / 2 + margin, d / 2 + margin
    left, front = piece.axes
    return piece.place + SIGNS[:, :1] * x * left + SIGNS[:, 1:] * z * front


def verts_on_floor(piece: Placed) -> Float[Tensor, "verts 3"]:
    """Vertices in the frame of the floor [m]."""
    verts, (left, front) = piece.furniture.mesh.verts.double().numpy(), piece.axes
    flat = piece.place + verts[:, :1] * left + verts[:, 2:] * front
    return torch.from_numpy(np.stack([flat[:, 0], verts[:, 1], flat[:, 1]], -1)).float()


def distances(
    piece: Placed, points: Float[np.ndarray, "points 3"], far: float = FAR
) -> Float[np.ndarray, " points"]:
    """Signed distance to a piece, negative inside, at most `far` [m]."""
    import igl

    flat, (left, front) = points[:, [0, 2]] - piece.place, piece.axes
    local = np.stack([flat @ left, points[:, 1], flat @ front], -1)
    verts = piece.furniture.mesh.verts.double().numpy()
    low, high = verts.min(0) - far, verts.max(0) + far
    near = np.flatnonzero(((local > low) & (local < high)).all(-1))
    out = np.full(len(points), far)
    if len(near):
        kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        faces = piece.furniture.mesh.faces.numpy()
        exact = igl.signed_distance(local[near], verts, faces, sign_type=kind)[0]
        out[near] = np.minimum(exact, far)
    return out


def free_of(
    point: Float[np.ndarray, "... 2"], pieces: tuple[Placed, ...], margin: float
) -> np.ndarray:
    """Whether points of the floor keep `margin` from every footprint [m]."""
    free = np.ones(point.shape[:-1], dtype=bool)
    for piece in pieces:
        w, _, d = piece.furniture.size
        flat, (left, front) = point - piece.place, piece.axes
        x, z = np.abs(flat @ left) - w / 2, np.abs(flat @ front) - d / 2
        gap = np.hypot(np.maximum(x, 0), np.maximum(z, 0)) + np.minimum(np.maximum(x, z), 0)
        free &= gap > margin
    return free


CELL = 0.06  # [m]
BODY = 0.28  # [m], people walk no nearer to furniture
ROOMY = 0.42  # [m], nearer than this one walks only where one must
DEAR = 6.0  # cost of a metre in between


class NoWayError(Exception):
    """There is no free path."""


def way(
    start: Float[np.ndarray, "2"],
    goal: Float[np.ndarray, "2"],
    pieces: tuple[Placed, ...],
    bounds: Float[np.ndarray, "2 2"],
) -> Floor:
    """Points (x, z) from start to goal, both included, inside of `bounds` [m].

    Raises:
        NoWayError: If furniture closes the way.
    """
    from scipy.sparse.csgraph import dijkstra

    shape = np.ceil((bounds[1] - bounds[0]) / CELL).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    points = bounds[0] + CELL * grid
    cost = np.where(free_of(points, pieces, ROOMY), 1.0, DEAR)
    open_ = free_of(points, pieces, BODY)
    index = [_nearest(points, open_, end) for end in (start, goal)]
    _, before = dijkstra(_graph(open_, cost), indices=index[0], return_predecessors=True)
    cells = [index[1]]
    while cells[-1] != index[0]:
        cells.append(int(before[cells[-1]]))
        if cells[-1] < 0:
            raise NoWayError(f"no way from {start.round(2).tolist()} to {goal.round(2).tolist()}")
    middle = points.reshape(-1, 2)[cells[::-1]]
    return _straightened(np.concatenate([start[None], middle, goal[None]]), pieces)


def _nearest(points: np.ndarray, open_: Bool[np.ndarray, "x z"], end: np.ndarray) -> int:
    far = np.where(open_, np.linalg.norm(points - end, axis=-1), np.inf)
    if far.min() > 0.3:
        raise NoWayError(f"{end.round(2).tolist()} is not free")
    return int(far.argmin())


def _graph(open_: Bool[np.ndarray, "x z"], cost: Float[np.ndarray, "x z"]) -> object:
    """Sparse graph of the eight neighbours of each open cell."""
    from scipy.sparse import coo_matrix

    number = np.arange(open_.size).reshape(open_.shape)
    rows, cols, costs = [], [], []
    for dx, dz in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = (slice(0, -dx or None), slice(max(0, -dz), -dz if dz > 0 else None))
        b = (slice(dx, None), slice(max(0, dz), dz if dz < 0 else None))
        both = open_[a] & open_[b]
        rows.append(number[a][both])
        cols.append(number[b][both])
        costs.append(np.hypot(dx, dz) * CELL * (cost[a][both] + cost[b][both]) / 2)
    parts = tuple(np.concatenate(p) for p in (rows, cols, costs))
    one_way = coo_matrix((parts[2], (parts[0], parts[1])), shape=(open_.size, open_.size))
    return (one_way + one_way.T).tocsr()


def _straightened(path: Floor, pieces: tuple[Placed, ...]) -> Floor:
    """Leave out corners where the straight line costs no more than the way around."""
    ends = np.cumsum(_costs(path[:-1], path[1:], pieces))
    cumulative = np.concatenate([[0.0], ends])
    kept, at = [0], 0
    while at < len(path) - 1:
        later = np.arange(len(path) - 1, at, -1)
        cost = _costs(np.repeat(path[at][None], len(later), 0), path[later], pieces)
        cheap = cost <= 1.01 * (cumulative[later] - cumulative[at]) + 1e-9
        at = int(later[np.flatnonzero(cheap)[0]]) if cheap.any() else at + 1
        kept.append(at)
    return path[kept]


def _costs(start: Floor, end: Floor, pieces: tuple[Placed, ...]) -> Float[np.ndarray, " lines"]:
    """Cost of straight lines; infinite where a line is blocked in its middle."""
    share = np.linspace(0, 1, 24)[:, None, None]
    points = start + share * (end - start)
    length = np.linalg.norm(end - start, axis=-1)
    near = np.where(free_of(points, pieces, ROOMY), 1.0, DEAR)
    inner = np.linalg.norm(points - start, axis=-1) > 0.3
    inner &= np.linalg.norm(points - end, axis=-1) > 0.3
    blocked = (~free_of(points, pieces, BODY) & inner).any(0)
    return np.where(blocked, np.inf, length * near.mean(0))
