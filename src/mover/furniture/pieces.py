"""A piece of furniture and how it is put together from convex parts.

Pieces are built standing on y = 0 with the front towards +z; a part is the convex hull of a few
points, so that shifting, tilting and mirroring a part is arithmetic on points.
"""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Float

from mover.core.records import record
from mover.core.types import Mesh

Part = Float[np.ndarray, "_ 3"]
Span = tuple[float, float]


@record
class Furniture:
    """One closed piece: +y up, +z front, origin at the centre of the box's bottom."""

    category: str  #: Canonical name
    style: int  #: Which design of the category it is
    mesh: Mesh  #: Closed, counter-clockwise seen from outside [m]
    seat_height: float  #: Height of the surface one sits or lies on [m]; 0: none
    seat_left: float  #: Smallest x of that surface [m]
    seat_right: float  #: Largest x of that surface [m]
    seat_back: float  #: Smallest z of that surface, where the backrest or the headboard begins [m]
    seat_front: float  #: Largest z of that surface: its front edge [m]
    back_height: float  #: Height of the backrest's upper edge [m]; 0: nothing to lean against
    top_height: float  #: Height of the highest surface that carries a hand or a thing [m]; 0: none

    @property
    def seat_depth(self) -> float:
        """From the backrest to the front edge [m]; 0: no seat."""
        return self.seat_front - self.seat_back

    @property
    def size(self) -> tuple[float, float, float]:
        """Edges of the box [m]."""
        low, high = self.mesh.verts.amin(0), self.mesh.verts.amax(0)
        x, y, z = (high - low).tolist()
        return x, y, z


@record
class Seat:
    """Where one sits on a piece, before the piece is centred [m]."""

    height: float
    x: Span
    z: Span
    back_height: float = 0.0


def block(x: Span, y: Span, z: Span, bevel: float = 0.0) -> Part:
    """A box between two corners [m], its edges cut by `bevel`."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
    signs = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)], dtype=float)
    corners = low + signs * (high - low)
    if bevel <= 0:
        return corners
    inward = (1 - 2 * signs) * bevel
    keep = 1 - np.eye(3)
    return np.concatenate([corners + inward * keep[axis] for axis in range(3)])


def pair(x: float) -> Span:
    """The same distance to both sides of the middle [m]."""
    return -x, x


def posts(xs: Iterable[float], zs: Iterable[float], y: Span, half: float) -> list[Part]:
    """Square bars upright at all pairs (x, z), of the thickness 2 * `half` [m]."""
    return [block((x - half, x + half), y, (z - half, z + half)) for x in xs for z in zs]


def upright(xs: Iterable[float], half: float, y: Span, z: Span) -> list[Part]:
    """Boards across x, of the thickness 2 * `half`, at each of the places [m]."""
    return [block((x - half, x + half), y, z) for x in xs]


def crosswise(x: Span, y: Span, zs: Iterable[float], half: float) -> list[Part]:
    """Boards across z, of the thickness 2 * `half`, at each of the places [m]."""
    return [block(x, y, (z - half, z + half)) for z in zs]


def rod(start: tuple[float, ...], end: tuple[float, ...], radii: Span, sides: int = 10) -> Part:
    """A tapered round bar from `start` to `end`; its flat ends are level [m].

    Bars that lie (no rise from start to end) get upright ends instead.
    """
    a, b = np.array(start, dtype=float), np.array(end, dtype=float)
    angle = (np.arange(sides) + 0.5) * 2 * np.pi / sides
    along = (b - a) / np.linalg.norm(b - a)
    if abs(along[1]) > 0.4:
        u, v = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    else:
        u = np.array([0, 1.0, 0])
        v = np.cross(u, along)
    ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    return np.concatenate([a + radii[0] * ring, b + radii[1] * ring])


def disc(centre: Span, y: Span, radius: float, sides: int = 32) -> Part:
    """An upright cylinder about (x, z) = `centre` [m]."""
    x, z = centre
    return rod((x, y[0], z), (x, y[1], z), (radius, radius), sides)


def tilted(part: Part, degrees: float, y: float, z: float) -> Part:
    """Lean `part` backwards by `degrees` about the line (y, z) that runs along x."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    dy, dz = part[:, 1] - y, part[:, 2] - z
    return np.stack([part[:, 0], y + c * dy + s * dz, z - s * dy + c * dz], axis=1)


def turned(part: Part, degrees: float, x: float = 0.0, z: float = 0.0) -> Part:
    """Rotate `part` about the upright axis through (x, z)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    dx, dz = part[:, 0] - x, part[:, 2] - z
    return np.stack([x + c * dx + s * dz, part[:, 1], z - s * dx + c * dz], axis=1)


def legs(x: float, z: float, top: float, radius: float, splay: float = 0.0) -> list[Part]:
    """Four legs under a frame with corners at (+-x, +-z) [m]; `splay` moves the feet outwards."""
    thin = radius if splay == 0 else 0.7 * radius
    sides = 4 if splay == 0 else 10
    return [
        rod((i * (x + splay), 0, k * (z + splay)), (i * x, top, k * z), (thin, radius), sides)
        for i in (-1, 1)
        for k in (-1, 1)
    ]


def join(parts: list[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] and faces of the union of convex parts: closed, outward, without voids."""
    from manifold3d import Manifold, OpType

    solids = [Manifold.hull_points(part) for part in parts]
    shells = Manifold.batch_boolean(solids, OpType.Add).decompose()
    solid = Manifold.compose([shell for shell in shells if shell.volume() > 0])
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts).astype(np.int64)


def finish(
    category: str, style: int, parts: list[Part], seat: Seat | None = None, top: float = 0.0
) -> Furniture:
    """Join the parts, move the origin to the centre of the box's bottom."""
    verts, faces = join(parts)
    low, high = verts.min(0), verts.max(0)
    origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    x, y, z = origin.tolist()
    mesh = Mesh(torch.from_numpy(verts - origin).float(), torch.from_numpy(faces))
    top = top - y if top else 0.0
    if seat is None:
        return Furniture(category, style, mesh, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, top)
    edges = (seat.x[0] - x, seat.x[1] - x, seat.z[0] - z, seat.z[1] - z)
    back = seat.back_height - y if seat.back_height else 0.0
    return Furniture(category, style, mesh, seat.height - y, *edges, back, top)


def draw(rng: np.random.Generator, low: float, high: float) -> float:
    """A size between `low` and `high`, in whole millimetres [m]."""
    return round(float(rng.uniform(low, high)), 3)
