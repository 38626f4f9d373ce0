"""Depth of the surface that each pixel sees, differentiable in the vertices of its triangle."""

import torch
from raster_torch_spans import LOW, Screen, Spans, inverse_depth
from torch import Tensor

GRAZING = 0.01  # sine of the angle below which a triangle's depth has no gradient
AGREE = 1e-3  # relative difference of plane and scan line in 1/z beyond which the plane is noise


def planes(verts_cam: Tensor, K: Tensor, faces: Tensor) -> Tensor:
    r"""Inverse depth of each triangle's plane as a function of the pixel.

    1/z = (n \cdot r) / (n \cdot v) with the viewing ray r of a pixel, the normal n and a vertex v.

    Args:
        verts_cam: Vertices of each item [m].
        K: Intrinsics of each item [px].
        faces: Vertices of all triangles, 3 rows, counted over all items.

    Returns:
        3 rows: change with the column, with the row, value at (0, 0) [1/m]; zeros where the
        triangle is seen edge-on or has no area.
    """
    a, b, c = verts_cam.reshape(-1, 3).index_select(0, faces.reshape(-1)).view(3, -1, 3)
    normal = torch.linalg.cross(b - a, c - a)
    toward = (normal * a).sum(-1)
    limit = GRAZING**2 * normal.square().sum(-1) * a.square().sum(-1)
    keep = (toward.square() > limit) & torch.isfinite(toward)
    normal = normal * (keep / torch.where(keep, toward, 1))[:, None]
    u, v, one = normal.view(len(verts_cam), -1, 3).unbind(-1)
    k = K[:, :, :, None]
    x, y = u / k[:, 0, 0], v / k[:, 1, 1]
    return torch.stack([x, y, one - x * k[:, 0, 2] - y * k[:, 1, 2]]).view(3, -1)


def surface(plane: Tensor, screen: Screen, runs: Spans, keys: Tensor, pixel: Tensor) -> Tensor:
    """Depth [m] of each pixel (flat), 0 but for those listed.

    Args:
        plane: Of all triangles, from `planes`.
        screen: Projected vertices.
        runs: What was drawn.
        keys: Winner of each pixel, from `zbuffer`.
        pixel: Pixels wanted; each has a winner.
    """
    _, height, width = screen.size
    seen = keys.index_select(0, pixel)
    run = seen & LOW
    line = runs.line.index_select(0, run)
    column = pixel - line * width + 0.5
    row = line % height + 0.5
    face = runs.face.index_select(0, run)
    per_x, per_y, start = (p.index_select(0, face) for p in plane.unbind(0))
    q = per_x * column + per_y * row + start
    scan = inverse_depth(seen, runs.nearest).to(q)
    z = 1 / torch.where((q - scan).abs() < AGREE * scan, q, scan)
    return z.new_zeros(len(keys)).scatter(0, pixel, z)
