"""Any furniture mesh as one closed solid in the same box.

Closed parts are kept as they are (solids.py): wound outward, flat holes capped, and united where
there are several, so that no walls stand inside walls. Everything else is wrapped (wrap.py).
"""

import numpy as np
import torch

from ..types import Mesh
from .mesh import fit_box, used
from .nearest import as_float64, as_int64
from .solids import areas, solid
from .topology import labels
from .wrap import wrap

WELD = 1e-6  # [longest side], vertices this near are one


def close_mesh(mesh: Mesh, cells: int = 96) -> Mesh:
    """One closed mesh, wound counter-clockwise seen from outside, in the box of the input.

    A closed, consistently wound mesh passes through: turned over if it is inside out, with
    duplicate vertices merged. Several closed parts are united. Everything else (holes,
    double-sided faces, soups) is wrapped at a resolution of 1/cells of the longest side.

    Args:
        mesh: Triangles of any kind; degenerate ones and unused vertices do not count.
        cells: Resolution along the longest side where the mesh must be wrapped.

    Raises:
        ValueError: If the mesh has no triangle with an area, or vertices that are not finite.
    """
    verts, faces = as_float64(mesh.verts), as_int64(mesh.faces)
    if not np.isfinite(verts[faces]).all():
        raise ValueError("close_mesh: the mesh has vertices that are not finite")
    if not (areas(verts[faces]) > 0).any():
        raise ValueError("close_mesh: the mesh has no triangle with an area")
    low, high = verts[faces].min((0, 1)), verts[faces].max((0, 1))
    verts, faces = _cleaned(verts, faces)
    found = solid(verts, faces)
    if found is None:
        found = wrap(verts, faces, cells)
    closed = used(Mesh(torch.from_numpy(found[0]), torch.from_numpy(found[1])))
    closed = fit_box(closed, torch.from_numpy(low), torch.from_numpy(high))
    return Mesh(closed.verts.to(mesh.verts), closed.faces.to(mesh.faces))


def _cleaned(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Without duplicate and unused vertices, repeated faces, and faces that are no triangles."""
    from scipy.spatial import KDTree

    name, faces = np.unique(faces, return_inverse=True)
    verts, faces = verts[name], faces.reshape(-1, 3)
    pairs = KDTree(verts).query_pairs(WELD * np.ptp(verts, axis=0).max(), output_type="ndarray")
    place = labels(pairs[:, 0], pairs[:, 1], len(verts))
    verts, faces = verts[np.unique(place, return_index=True)[1]], place[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    turned = np.take_along_axis(faces, (faces.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    return verts, faces[np.sort(np.unique(turned, axis=0, return_index=True)[1])]
