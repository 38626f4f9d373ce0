"""Furniture that stands in a room: places on the floor, free space, depth of bodies inside it."""

import numpy as np
from jaxtyping import Float

from ..furniture import Furniture
from ..records import record
from .turns import facing, left_of

SIGNS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # of the corners of a footprint
FAR = 0.03  # [m], signed distances beyond this are not told apart


@record
class Placed:
    """A piece on the floor of a room (+y up, the floor at y = 0)."""

    id: str
    furniture: Furniture
    at: tuple[float, float]
    """x and z of the centre of the base [m]."""
    heading: float
    """Rotation about +y; 0 faces +z, towards the camera [rad]."""

    @property
    def place(self) -> Float[np.ndarray, "2"]:
        """X and z of the centre of the base [m]."""
        return np.array(self.at)


@record
class Spot:
    """An edge that one can sit on."""

    edge: Float[np.ndarray, "2"]
    """A point on the front edge of the seat (x, z) [m]."""
    heading: float
    """Where the sitter looks [rad]."""
    height: float
    """[m]"""
    depth: float
    """From the edge to the backrest, or to the far edge [m]."""
    lip: float
    """How far the base stands out under the edge [m]."""
    has_back: bool
    piece: int
    """Index of the piece."""


def on_floor(piece: Placed, x: float, z: float) -> Float[np.ndarray, "2"]:
    """Place on the floor (x, z) of a point in the axes of the piece [m]."""
    return piece.place + x * left_of(np.array(piece.heading)) + z * facing(np.array(piece.heading))


def corners(piece: Placed, margin: float = 0.0) -> Float[np.ndarray, "4 2"]:
    """Corners of the footprint of a piece, grown by `margin` [m]."""
    w, _, d = piece.furniture.size
    x, z = w / 2 + margin, d / 2 + margin
    heading = np.array(piece.heading)
    return piece.place + SIGNS[:, :1] * x * left_of(heading) + SIGNS[:, 1:] * z * facing(heading)


def verts_on_floor(piece: Placed) -> Float[np.ndarray, "verts 3"]:
    """Vertices in the frame of the floor [m]."""
    verts = piece.furniture.mesh.verts.double().numpy()
    flat = (
        piece.place
        + verts[:, :1] * left_of(np.array(piece.heading))
        + verts[:, 2:] * facing(np.array(piece.heading))
    )
    return np.stack([flat[:, 0], verts[:, 1], flat[:, 1]], -1)


def distances(
    piece: Placed, points: Float[np.ndarray, "points 3"], far: float = FAR
) -> Float[np.ndarray, " points"]:
    """Signed distance to a piece, negative inside, at most `far` [m]."""
    import igl

    flat = points[:, [0, 2]] - piece.place
    x = flat @ left_of(np.array(piece.heading))
    z = flat @ facing(np.array(piece.heading))
    local = np.stack([x, points[:, 1], z], -1)
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
        flat = point - piece.place
        x = np.abs(flat @ left_of(np.array(piece.heading))) - w / 2
        z = np.abs(flat @ facing(np.array(piece.heading))) - d / 2
        gap = np.hypot(np.maximum(x, 0), np.maximum(z, 0)) + np.minimum(np.maximum(x, z), 0)
        free &= gap > margin
    return free
