"""A naive ray caster in float64 numpy: every ray against every triangle, written on its own."""

import numpy as np

CHUNK = 4_000_000  # ray-triangle pairs at a time


def cast(verts_cam, faces, K, height, width):
    """Moeller-Trumbore on the ray through each pixel centre, triangles of any winding.

    Returns depth of the first hit (inf: none) and of the last (-inf: none), the first hit's
    triangle (-1: none), and the number of hits; each of shape (height, width).
    """
    return _cast(*_arrays(verts_cam, faces, K), height, width)


def cast_backs(verts_cam, faces, K, height, width):
    """The same for triangles that are seen from behind (wound counter-clockwise from outside)."""
    verts, faces, K = _arrays(verts_cam, faces, K)
    a, b, c = (verts[faces[:, k]] for k in range(3))
    away = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) > 0
    return _cast(verts, faces[away], K, height, width)


def draw(meshes, camera):
    """Index of the mesh that each pixel of `camera` sees, -1 where none.

    Args:
        meshes: Pairs of vertices in the world [m] and triangles.
        camera: With K, R_cam_world, width and height, standing at the world's origin.
    """
    R = np.asarray(camera.R_cam_world, np.float64)
    nearest = np.full((camera.height, camera.width), np.inf)
    seen = np.full((camera.height, camera.width), -1)
    for index, (verts, faces) in enumerate(meshes):
        verts_cam = np.asarray(verts, np.float64) @ R.T
        front = cast(verts_cam, faces, camera.K, camera.height, camera.width)[0]
        closer = front < nearest
        nearest[closer], seen[closer] = front[closer], index
    return seen


def _arrays(verts, faces, K):
    return np.asarray(verts, np.float64), np.asarray(faces, np.int64), np.asarray(K, np.float64)


def _window(verts, K, height, width):
    """Rows and columns that can be hit: all of them if anything is behind the camera."""
    if len(verts) == 0:
        return slice(0, 0), slice(0, 0)
    if verts[:, 2].min() <= 1e-6:
        return slice(0, height), slice(0, width)
    pixels = verts @ K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    low = np.clip(np.floor(pixels.min(0)) - 1, 0, [width, height]).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 1, 0, [width, height]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def _cast(verts, faces, K, height, width):
    front, back = np.full((height, width), np.inf), np.full((height, width), -np.inf)
    face_index, count = np.full((height, width), -1), np.zeros((height, width), int)
    rows, columns = _window(verts[np.unique(faces)], K, height, width)
    grid = np.stack(np.meshgrid(np.arange(width)[columns] + 0.5, np.arange(height)[rows] + 0.5), -1)
    rays = np.concatenate([grid, np.ones_like(grid[..., :1])], -1) @ np.linalg.inv(K).T
    flat = rays.reshape(-1, 3)
    step = max(1, CHUNK // max(len(faces), 1))
    parts = [_hits(flat[i : i + step], verts[faces]) for i in range(0, len(flat), step)]
    if parts:
        for k, image in enumerate((front, back, face_index, count)):
            image[rows, columns] = np.concatenate([p[k] for p in parts]).reshape(grid.shape[:2])
    return front, back, face_index, count


def _hits(rays, triangles):
    """Hits of rays from the origin; a ray's z is 1, so that distance along it is depth."""
    a = triangles[:, 0]
    e1, e2 = triangles[:, 1] - a, triangles[:, 2] - a
    cross = np.cross(-a, e1)
    # with p = ray x e2: det = e1.p, u = -a.p / det, v = ray.q / det, t = e2.q / det, q = -a x e1
    det = rays @ np.cross(e2, e1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u = rays @ np.cross(e2, -a).T / det
        v = rays @ cross.T / det
        inside = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (det != 0)
    ray, face = np.nonzero(inside)
    t = np.einsum("fi,fi->f", e2, cross)[face] / det[ray, face]
    ray, face, t = (x[t > 0] for x in (ray, face, t))
    first, last = np.full(len(rays), np.inf), np.full(len(rays), -np.inf)
    np.minimum.at(first, ray, t)
    np.maximum.at(last, ray, t)
    index, nearest = np.full(len(rays), -1), np.flatnonzero(t == first[ray])[::-1]
    index[ray[nearest]] = face[nearest]
    return first, last, index, np.bincount(ray, minlength=len(rays))
