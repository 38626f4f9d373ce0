"""Which frame and which person gave the depth bounds that an object feels.

The maps remember no frames. So the few pixels in which an object is nearest to a bound are taken,
and for each the body is looked for whose surface the ray of that pixel crosses at that very depth.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..explanation_records import Bound
from ..geometry.camera import NEAR, project, to_camera, to_world
from ..geometry.crops import grid_in_image
from ..geometry.raster import Depths, Views
from ..terms.depth import DepthRange
from ..types import Bodies, Camera
from .small import small_camera

FEW = 8  # pixels of each object and side whose body is looked for
CLOSE = 0.05  # [m], pixels whose slack is that near to the least one are held as well
ODD = 0.05  # share of an object's pixels whose bounds may come from a wrong mask
SAME = 0.005  # [m], between a bound and the surface that gave it
EDGE = 1e-3  # of a triangle, by which a pixel centre may lie beside it


@dataclass(frozen=True)
class _Tight:
    """The tightest pixels of one object and side."""

    object: int
    side: str
    pixels: Float[Tensor, "few 2"]
    """Pixel centres in the image 640 wide."""
    depth: Float[Tensor, " few"]
    """The bounds there [m]."""
    slack: Float[Tensor, " few"]
    least: float
    """The least slack, but for odd pixels."""
    count: int


def bounds_of_objects(
    seen: Depths,
    masks: Float[Tensor, "objects h w"],
    depth: DepthRange,
    views: Views,
    who: tuple[Bodies, Camera],
) -> tuple[tuple[Bound, ...], ...]:
    """The near and the far bound of each object, where it has any.

    Args:
        seen: Depth of the objects at their places, in their windows.
        masks: Their masks there.
        depth: The bounds there.
        views: The windows.
        who: The bodies whose frames were gathered, in the world, and the camera.
    """
    bodies, camera = who
    inside = seen.covered & (masks > 0.5)
    sane = inside & (depth.near < depth.far)
    x, y = grid_in_image(views, small_camera(camera).K)
    found: list[_Tight] = []
    for side, bound, slack in (
        ("near", depth.near, seen.nearest - depth.near),
        ("far", depth.far, depth.far - seen.nearest),
    ):
        known = sane & bound.isfinite()
        for i in known.any(-1).any(-1).nonzero()[:, 0].tolist():
            found.append(_tightest(i, side, (known[i], bound[i], slack[i]), (x[i], y[i])))
    owner = _owners(found, bodies, camera)
    told = [_bound(t, owner[k], bodies) for k, t in enumerate(found)]
    return tuple(
        tuple(b for t, b in zip(found, told, strict=True) if t.object == i)
        for i in range(len(masks))
    )


def _tightest(
    index: int, side: str, maps: tuple[Tensor, Tensor, Tensor], grid: tuple[Tensor, Tensor]
) -> _Tight:
    known, bound, slack = maps
    rows, columns = known.nonzero(as_tuple=True)
    order = slack[rows, columns].argsort(stable=True)
    rows, columns = rows[order], columns[order]
    ordered = slack[rows, columns]
    least = ordered[int(ODD * len(order))]
    held = int((ordered <= least.clamp_min(0) + CLOSE).sum())
    few = torch.linspace(0, held - 1, min(FEW, held)).round().long()
    rows, columns = rows[few], columns[few]
    x, y = grid
    middle = torch.stack([(x[columns] + x[columns + 1]) / 2, (y[rows] + y[rows + 1]) / 2], -1)
    pixels, depth = middle.floor() + 0.5, bound[rows, columns]
    return _Tight(index, side, pixels, depth, ordered[few], float(least), held)


def _bound(tight: _Tight, owner: Int[Tensor, " few"], bodies: Bodies) -> Bound:
    """The bound of the body that gave most of the pixels, at its tightest one that is not odd."""
    frame = person = -1
    mine = torch.ones_like(owner, dtype=torch.bool)
    if bool((owner >= 0).any()):
        body = int(owner[owner >= 0].mode().values)
        frame, person = int(bodies.frame[body]), int(bodies.person[body])
        mine = owner == body
    usual = mine & (tight.slack >= tight.least)
    at = int((usual if bool(usual.any()) else mine).nonzero()[0, 0])  # tightest first
    side = "near" if tight.side == "near" else "far"
    return Bound(side, float(tight.depth[at]), float(tight.slack[at]), frame, person, tight.count)


def _owners(found: list[_Tight], bodies: Bodies, camera: Camera) -> list[Int[Tensor, " few"]]:
    """For each pixel the body whose surface lies at its bound; -1: none does."""
    if not found:
        return []
    small = small_camera(camera)
    pixels = torch.cat([t.pixels for t in found])
    depth = torch.cat([t.depth for t in found])
    best, owner = torch.full_like(depth, SAME), torch.full((len(depth),), -1)
    may = _may_give(pixels, depth, bodies, small)
    for row in may.any(-1).nonzero()[:, 0].tolist():  # one at a time: memory stays that of one
        asked = may[row].nonzero()[:, 0]
        there = to_camera(bodies.verts[row], small.R_cam_world)
        flat = project(there, small.K)
        away = _nearest_crossing(flat, there[:, 2], bodies.faces, pixels[asked], depth[asked])
        wins = away < best[asked]
        best[asked[wins]], owner[asked[wins]] = away[wins], row
    return list(owner.split([len(t.pixels) for t in found]))


def _may_give(
    pixels: Float[Tensor, "pixels 2"],
    depth: Float[Tensor, " pixels"],
    bodies: Bodies,
    small: Camera,
) -> Bool[Tensor, "bodies pixels"]:
    """Whether the box around a body holds the point where a pixel's ray reaches its bound."""
    rays = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ torch.linalg.inv(small.K).mT
    points = to_world(rays * depth.unsqueeze(-1), small.R_cam_world)
    low, high = bodies.verts.amin(1) - 2 * SAME, bodies.verts.amax(1) + 2 * SAME
    ahead = to_camera(bodies.verts, small.R_cam_world)[..., 2].amin(1) > NEAR
    inside = (points >= low[:, None]) & (points <= high[:, None])
    return inside.all(-1) & ahead[:, None]


def _nearest_crossing(
    flat: Float[Tensor, "verts 2"],
    z: Float[Tensor, " verts"],
    faces: Int[Tensor, "faces 3"],
    pixels: Float[Tensor, "asked 2"],
    depth: Float[Tensor, " asked"],
) -> Float[Tensor, " asked"]:
    """Least difference between a depth and the surfaces that the ray of its pixel crosses [m]."""
    low, high = pixels.amin(0), pixels.amax(0)
    away = torch.full_like(depth, torch.inf)
    a, b, c = flat[faces].unbind(1)
    some = _touches((a, b, c), low, high).nonzero()[:, 0]
    a, b, c, corners = a[some], b[some], c[some], faces[some]
    for k, pixel in enumerate(pixels):
        mine = _touches((a, b, c), pixel, pixel).nonzero()[:, 0]
        share = _shares(a[mine], b[mine], c[mine], pixel)
        crossed = 1 / (share / z[corners[mine]]).sum(-1)
        crossed = torch.where(share.amin(-1) >= -EDGE, crossed, torch.inf)
        if len(crossed):
            away[k] = (crossed - depth[k]).abs().amin()
    return away


def _touches(
    corners: tuple[Tensor, Tensor, Tensor], low: Tensor, high: Tensor
) -> Bool[Tensor, " faces"]:
    """Triangles whose rectangle meets another one."""
    a, b, c = corners
    least, most = torch.minimum(torch.minimum(a, b), c), torch.maximum(torch.maximum(a, b), c)
    return ((least <= high) & (most >= low)).all(-1)


def _shares(a: Tensor, b: Tensor, c: Tensor, pixel: Tensor) -> Float[Tensor, "faces 3"]:
    """Barycentric coordinates of a pixel in triangles of the image."""

    def twice(p: Tensor, q: Tensor, r: Tensor) -> Tensor:
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    at = pixel.expand_as(a)
    area = twice(a, b, c)
    area = torch.where(area.abs() < 1e-9, torch.full_like(area, torch.nan), area)
    parts = [twice(b, c, at), twice(c, a, at), twice(a, b, at)]
    return torch.nan_to_num(torch.stack(parts, -1) / area.unsqueeze(-1), nan=-1.0)
