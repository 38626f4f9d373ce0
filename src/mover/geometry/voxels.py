"""Closed triangle meshes on a grid: winding numbers of places, and what is near the surface.

Vertices are in cells here: the centres of the grid's cells have integer coordinates.
"""

import numpy as np

SNAP = 1 << 16  # vertices snap to this part of a cell, so that crossings are exact
SPACING = 0.8  # [cells] between marks on the surface; no point is further than 0.47 from one
REACH = 2  # [cells] along each axis from the cell of a mark


def outward(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces, turned over if they enclose a negative volume (as in a mirrored body)."""
    a, b, c = (verts[faces[:, k]] - verts[0] for k in range(3))
    return faces if (np.cross(a, b) * c).sum() >= 0 else faces[:, ::-1].copy()


def winding(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Winding number of the surface at integer places (x, y, z) below `shape`.

    Counts signed crossings along the y lines. Coordinates x and z are snapped to fixed point and
    the top-left rule decides ties, so that a line through a shared edge or vertex counts once.
    """
    flat = np.rint(verts[:, [0, 2]] * SNAP).astype(np.int64)[faces]
    area = _cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    flip = area < 0  # seen from below, a triangle that faces down winds counter-clockwise
    flat[flip] = flat[flip][:, [0, 2, 1]]
    heights = verts[:, 1][faces]
    heights[flip] = heights[flip][:, [0, 2, 1]]
    triangle, column = _pairs(flat, area != 0, shape)
    covered, height = _crossings(flat[triangle], heights[triangle], column)
    triangle, column = triangle[covered], column[covered]
    first = np.clip(np.ceil(height), 0, shape[1]).astype(np.int64)
    place = (column[:, 0] * (shape[1] + 1) + first) * shape[2] + column[:, 1]
    steps = np.bincount(
        place, np.sign(area[triangle]), minlength=int(shape[0] * (shape[1] + 1) * shape[2])
    ).reshape(shape[0], shape[1] + 1, shape[2])
    return np.cumsum(steps[:, :-1], axis=1).astype(np.int32)


def _pairs(flat: np.ndarray, keep: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and the columns (x, z) that their boxes hold, as one ragged list of pairs."""
    low = np.maximum(-(-flat.min(1) // SNAP), 0)
    high = np.minimum(flat.max(1) // SNAP, shape[[0, 2]] - 1)
    sides = np.where(keep[:, None], np.maximum(high - low + 1, 0), 0)
    counts = sides.prod(-1)
    triangle = np.repeat(np.arange(len(flat)), counts)
    rank = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
    wide = sides[triangle, 1]
    return triangle, low[triangle] + np.stack([rank // wide, rank % wide], -1)


def _crossings(
    corners: np.ndarray, heights: np.ndarray, column: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether each triangle holds its column, and at what height [cells] the ones that do."""
    point = column * SNAP
    covered = np.ones(len(column), dtype=bool)
    weights = np.empty((len(column), 3), dtype=np.int64)
    for k in range(3):
        start = corners[:, (k + 1) % 3]
        edge = corners[:, (k + 2) % 3] - start
        weights[:, k] = _cross(edge, point - start)
        owns = (edge[:, 1] < 0) | ((edge[:, 1] == 0) & (edge[:, 0] > 0))
        covered &= (weights[:, k] > 0) | ((weights[:, k] == 0) & owns)
    share = weights[covered] / weights[covered].sum(-1, keepdims=True)
    return covered, (share * heights[covered]).sum(-1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def near_surface(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The places below `shape` that are nearer than two cells to the surface, and some more.

    Such a place is less than 2 + 0.47 + 0.5 cells from a marked one along any axis (the distance
    to a point of the surface, from there to the next mark, and the mark's rounding): at most
    `REACH` whole cells.
    """
    return _grown(_marks(verts, faces, shape), REACH)


def _marks(verts: np.ndarray, faces: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Cells of points on the surface, no further apart than SPACING."""
    corners = verts[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(-1)
    parts = np.maximum(np.ceil(longest / SPACING), 1).astype(np.int64)
    marks = np.zeros(shape, dtype=bool)
    for count in np.unique(parts):
        i, j = np.nonzero(np.tri(count + 1, dtype=bool)[::-1])
        share = np.stack([i, j, count - i - j], -1) / count
        points = np.rint(share @ corners[parts == count]).astype(np.int64).reshape(-1, 3)
        points = points[((points >= 0) & (points < shape)).all(-1)]
        marks[tuple(points.T)] = True
    return marks


def _grown(mask: np.ndarray, cells: int) -> np.ndarray:
    """The mask and everything within `cells` of it along each axis."""
    for axis in range(3):
        view = np.moveaxis(mask, axis, 0)
        grown = view.copy()
        for step in range(1, cells + 1):
            grown[step:] |= view[:-step]
            grown[:-step] |= view[step:]
        mask = np.moveaxis(grown, 0, axis)
    return mask
