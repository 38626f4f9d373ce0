"""Meshes as other programs make them: another piece of the category, smoothed, wrapped or torn.

Each starts from another design of the same class, whose proportions are changed, and goes through
one of several makers, so that no one style of errors is learnt:

- `smooth`: a fine grid, smoothed, as networks from an image to a solid leave it;
- `blocky`: a coarse grid of matter (occupancy networks, 32 cells a side);
- `sphere`: a sphere of 2562 vertices drawn onto the surface, faces that bridge gaps cut out, as
  Total3D does (Sec. 3.3 there); never closed;
- `soup`: flat faces with two sides, some of them turned over, as in collections of CAD models.

Then the mesh is warped by a few per cent of its size, and some lose what a camera does not see.
"""

import numpy as np
import torch
from jaxtyping import Float

from mover.core.types import Mesh
from mover.furniture.library import another
from mover.furniture.pieces import Furniture
from mover.geometry.mesh import face_normals, fit_box, used
from mover.geometry.topology import Triangles, level_set

KNOTS = 4  # stretches along each axis that change their share of the size
PROPORTION = 0.2  # by which a stretch grows or shrinks, drawn evenly
TORN = 0.4  # share of meshes without what faces down or back
FINE, COARSE = (44, 56), (20, 28)  # cells along the longest side
ROUNDS = 30  # steps of the sphere towards the surface
BRIDGE = 0.06  # of the size: faces of the sphere farther from the surface are cut out


def foreign_mesh(known: Furniture, warp: float, rng: np.random.Generator) -> Mesh:
    """Another piece of the class as another program would give it, in the box of a known piece.

    `warp` is its root mean square displacement, as a share of the size.
    """
    mesh = another(known, rng).mesh
    verts = mesh.verts.double().numpy()
    low, size = verts.min(0), np.ptp(verts, axis=0)
    verts = np.stack([_stretched((verts[:, k] - low[k]) / size[k], rng) for k in range(3)], -1)
    wanted = np.array(known.size)
    maker = MAKERS[int(rng.integers(len(MAKERS)))]
    verts, faces = maker((verts * wanted, mesh.faces.numpy()), rng)
    verts = verts + warp * wanted * _waves(verts / wanted, rng)
    out = Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces.astype(np.int64)))
    if rng.uniform() < TORN:  # what looks down or back is not there
        normals = face_normals(out.verts, out.faces)
        seen = ~((normals[:, 1] < -0.7) | (normals[:, 2] < -0.7))
        out = Mesh(out.verts, out.faces[seen]) if int(seen.sum()) > 50 else out
    out = used(out)
    high = torch.tensor([wanted[0] / 2, wanted[1], wanted[2] / 2]).float()
    return fit_box(out, high * torch.tensor([-1.0, 0.0, -1.0]), high)


def _stretched(at: Float[np.ndarray, " verts"], rng: np.random.Generator) -> np.ndarray:
    """Places in [0, 1] moved so that stretches between knots change their lengths, ends kept."""
    steps = 1 + PROPORTION * rng.uniform(-1, 1, KNOTS)
    knots = np.concatenate([[0.0], steps.cumsum()]) / steps.sum()
    return np.interp(at, np.linspace(0, 1, KNOTS + 1), knots)


def _waves(at: Float[np.ndarray, "verts 3"], rng: np.random.Generator) -> np.ndarray:
    """A smooth displacement of root mean square one: a few long waves along each axis."""
    total = np.zeros_like(at)
    for _ in range(4):
        wave, phase = rng.normal(0, 3.0, 3), rng.uniform(0, 2 * np.pi)
        total += np.sin(at @ wave + phase)[:, None] * rng.normal(size=3)
    return total / np.sqrt(2.0)


def _grid(
    mesh: Triangles, cells: int, blur: float, level: float, *, matter: bool = False
) -> Triangles:
    """The surface of a grid's distances (or of its matter), blurred [cells]."""
    import igl
    from scipy.ndimage import gaussian_filter

    verts, faces = mesh
    cell = float(np.ptp(verts, axis=0).max()) / cells
    start = verts.min(0) - 4 * cell
    counts = (np.ceil(np.ptp(verts, axis=0) / cell) + 9).astype(int)
    axes = [start[k] + cell * np.arange(counts[k]) for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
    signed = np.asarray(igl.signed_distance(places, verts, faces.astype(np.int64))[0]) / cell
    field = signed.reshape(counts[::-1].tolist()).clip(-3, 3)
    if matter:
        field = np.where(field < level, -1.0, 1.0)
        level = 0.2
    field = gaussian_filter(field, blur)
    return level_set(field.transpose(2, 1, 0), start, cell, level)


def _smooth(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """Thin parts grow by about a cell, or they would be lost."""
    blur = float(rng.uniform(0.7, 1.3))
    return _grid(mesh, int(rng.integers(*FINE)), blur, 0.3 + 0.6 * blur)


def _blocky(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    return _grid(mesh, int(rng.integers(*COARSE)), 0.5, 0.75, matter=True)


def _sphere(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """A sphere drawn onto the surface, without the faces that bridge its gaps."""
    import igl
    import trimesh

    verts, faces = mesh
    ball = trimesh.creation.icosphere(subdivisions=4)
    shell = np.asarray(ball.faces)
    size = np.ptp(verts, axis=0)
    points = np.asarray(ball.vertices) * size * rng.uniform(0.55, 0.75) + verts.min(0) + size / 2
    ends = np.concatenate([shell[:, [0, 1]], shell[:, [1, 2]], shell[:, [2, 0]]])
    count = np.bincount(ends[:, 0], minlength=len(points))[:, None]
    for step in range(ROUNDS):
        onto = np.asarray(igl.point_mesh_squared_distance(points, verts, faces.astype(np.int64))[2])
        middle = np.zeros_like(points)
        np.add.at(middle, ends[:, 0], points[ends[:, 1]])
        pull = 0.3 + 0.5 * step / ROUNDS
        points = (1 - pull) * (middle / count) + pull * onto
    centre = points[shell].mean(1)
    off = np.asarray(igl.point_mesh_squared_distance(centre, verts, faces.astype(np.int64))[0])
    return points, shell[np.sqrt(off) < BRIDGE * size.max()]


def _soup(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """Faces without neighbours, some turned over, some with two sides."""
    import trimesh

    verts, faces = mesh
    longest = float(np.ptp(verts, axis=0).max()) / 6
    verts, faces = trimesh.remesh.subdivide_to_size(verts, faces, longest)[:2]
    turned = rng.uniform(size=len(faces)) < 0.3
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    twice = faces[rng.uniform(size=len(faces)) < 0.2]
    return np.asarray(verts), np.concatenate([faces, twice[:, ::-1]])


MAKERS = (_smooth, _blocky, _sphere, _soup)  #: the ways in which other programs make a mesh
