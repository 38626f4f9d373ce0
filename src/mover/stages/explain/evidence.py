"""Who gave the evidence of an object: depth bounds, the nearest body, and whom it touches.

The maps of depth and free space remember no frames. So the few pixels in which an object is nearest
to a bound are taken, and for each the body is looked for whose surface lies there at that very
depth; and for the point of an object that is nearest to free space's end, the body that is there.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.explanation import Bound, Passing, TouchingBody
from mover.core.types import Bodies, Camera, Layout, Mesh, Objects
from mover.energy.terms.contact import ContactPoints
from mover.energy.terms.depth import DepthRange
from mover.geometry.camera import NEAR, to_camera, to_world
from mover.geometry.crops import grid_in_image
from mover.geometry.mesh import signed_volume, vertex_normals
from mover.geometry.placement import place
from mover.geometry.raster import Crops, Depths, layers
from mover.geometry.volume import SHELL, Volume, sample
from mover.geometry.warp_start import mapped
from mover.stages.masks import small_camera

FEW = 8  # pixels of each object and side whose body is looked for
CLOSE = 0.05  # [m], pixels whose slack is that near to the least one are held as well
ODD = 0.05  # share of an object's pixels whose bounds may come from a wrong mask
SAME = 0.005  # [m], between a bound and the surface that gave it
PAUSE = 10  # frames (of those that are common between two bodies) that end a touch
SIDES = (("left", "right"), ("bottom", "top"), ("back", "front"))


@dataclass(frozen=True)
class _Tight:
    """The tightest pixels of one object and side."""

    object: int
    side: Literal["near", "far"]
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
    views: Crops,
    who: tuple[Bodies, Camera],
) -> tuple[tuple[Bound, ...], ...]:
    """The near and the far bound of each object, where it has any."""
    bodies, camera = who
    sane = seen.covered & (masks > 0.5) & (depth.near < depth.far)
    x, y = grid_in_image(views, small_camera(camera).K)
    tight: list[_Tight] = []
    sides: tuple[tuple[Literal["near", "far"], Tensor, Tensor], ...] = (
        ("near", depth.near, seen.nearest - depth.near),
        ("far", depth.far, depth.far - seen.nearest),
    )
    for side, bound, slack in sides:
        known = sane & bound.isfinite()
        for i in known.any(-1).any(-1).nonzero()[:, 0].tolist():
            tight.append(_tightest(i, side, (known[i], bound[i], slack[i]), (x[i], y[i])))
    found: list[list[Bound]] = [[] for _ in masks]
    for one, owner in zip(tight, _owners_of_pixels(tight, bodies, camera), strict=True):
        found[one.object].append(_bound(one, owner, bodies))
    return tuple(tuple(bounds) for bounds in found)


def _tightest(
    index: int,
    side: Literal["near", "far"],
    maps: tuple[Tensor, Tensor, Tensor],
    grid: tuple[Tensor, Tensor],
) -> _Tight:
    known, bound, slack = maps
    rows, columns = known.nonzero(as_tuple=True)
    order = slack[rows, columns].argsort(stable=True)
    ordered = slack[rows, columns][order]
    least = ordered[int(ODD * len(order))]
    count = int((ordered <= least.clamp_min(0) + CLOSE).sum())
    few = torch.linspace(0, count - 1, min(FEW, count)).round().long()
    rows, columns = rows[order][few], columns[order][few]
    x, y = grid
    middle = torch.stack([(x[columns] + x[columns + 1]) / 2, (y[rows] + y[rows + 1]) / 2], -1)
    pixels = middle.floor() + 0.5
    return _Tight(index, side, pixels, bound[rows, columns], ordered[few], float(least), count)


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
    depth, slack = float(tight.depth[at]), float(tight.slack[at])
    return Bound(tight.side, depth, slack, frame, person, tight.count)


def _owners_of_pixels(
    tight: list[_Tight], bodies: Bodies, camera: Camera
) -> list[Int[Tensor, " few"]]:
    """For each pixel the body whose surface lies at its bound; -1: none does."""
    if not tight:
        return []
    small = small_camera(camera)
    pixels, depth = torch.cat([t.pixels for t in tight]), torch.cat([t.depth for t in tight])
    best, owner = torch.full_like(depth, SAME), torch.full((len(depth),), -1)
    may = _may_give(pixels, depth, bodies, small)

    def away(row: int) -> tuple[Int[Tensor, " asked"], Float[Tensor, " asked"]]:
        asked = may[row].nonzero()[:, 0]
        K = small.K.repeat(len(asked), 1, 1)
        K[:, :2, 2] -= pixels[asked].floor()
        verts = to_camera(bodies.verts[row], small.R_cam_world).expand(len(asked), -1, -1)
        drawn = layers(verts, bodies.faces, Crops(K, 1, 1))
        ends = torch.stack([drawn.front, drawn.exit]).flatten(1)
        return asked, ends.sub(depth[asked]).abs().amin(0)

    rows = may.any(-1).nonzero()[:, 0].tolist()
    for row, (asked, off) in zip(rows, mapped(away, rows), strict=True):  # memory: one a thread
        wins = off < best[asked]
        best[asked[wins]], owner[asked[wins]] = off[wins], row
    return list(owner.split([len(t.pixels) for t in tight]))


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


def passing_by(
    objects: Objects, layout: Layout, volume: Volume, bodies: Bodies
) -> tuple[Passing, ...]:
    """The nearest body of each object, by the sample of its surface that is nearest to any.

    The distance is that of the volume; the body is the one whose vertices agree with it best.
    """
    reach = SHELL * volume.cell
    samples = place(objects.samples, layout)
    distance, index = sample(volume, samples).min(-1)
    rows = torch.arange(len(index))
    points, local = samples[rows, index], objects.samples[rows, index]
    found: list[Passing] = []
    for i, body in enumerate(_owners_of_points(points, distance, bodies, reach)):
        if body < 0 or float(distance[i]) >= reach:
            found.append(Passing(reach, -1, -1, ""))
            continue
        frame, person = int(bodies.frame[body]), int(bodies.person[body])
        side = side_of(local[i], objects.size[i])
        found.append(Passing(float(distance[i]), frame, person, side))
    return tuple(found)


def side_of(point: Float[Tensor, "3"], size: Float[Tensor, "3"]) -> str:
    """The side of an object's box that a point of its surface is nearest to."""
    middle = torch.stack([torch.zeros_like(size[1]), size[1] / 2, torch.zeros_like(size[1])])
    share = (point - middle) / (size / 2).clamp_min(1e-6)
    axis = int(share.abs().argmax())
    return SIDES[axis][int(share[axis] > 0)]


def _owners_of_points(
    points: Float[Tensor, "objects 3"],
    distance: Float[Tensor, " objects"],
    bodies: Bodies,
    reach: float,
) -> list[int]:
    """The body of each point, by the distance from its nearest vertex; -1 where none is near."""
    best, owner = torch.full_like(distance, torch.inf), torch.full((len(points),), -1)
    if not len(bodies.verts):
        return owner.tolist()
    inverted = signed_volume(Mesh(bodies.verts[0], bodies.faces)) < 0
    for row, verts in enumerate(bodies.verts):  # one at a time: memory stays that of one
        beside = (verts.amin(0) - points).relu() + (points - verts.amax(0)).relu()
        close = beside.norm(dim=-1) <= distance.abs() + reach
        asked = ((distance < reach) & close).nonzero()[:, 0]
        if not len(asked):
            continue
        away, index = torch.cdist(points[asked], verts).min(-1)
        outward = vertex_normals(verts, bodies.faces)[index] * (-1 if inverted else 1)
        behind = ((points[asked] - verts[index]) * outward).sum(-1) < 0
        signed = torch.where(behind, -away, away)
        wins = signed < best[asked]
        best[asked[wins]], owner[asked[wins]] = signed[wins], row
    return owner.tolist()


def touching_of(
    objects: Objects,
    layout: Layout,
    contacts: ContactPoints | None,
    pairs: Int[Tensor, "pairs 3"],
    bodies: Bodies,
) -> tuple[tuple[TouchingBody, ...], ...]:
    """For each object and part the people who touch it, those who do it longest first."""
    found: list[list[TouchingBody]] = [[] for _ in objects.ids]
    if contacts is None:
        return tuple(() for _ in found)
    gap, used = _gaps(objects, layout, contacts), (contacts.weight > 0).any(-1)
    row = {o: k for k, o in enumerate(contacts.object_of.tolist())}
    keys = torch.stack([pairs[:, 1], pairs[:, 2], bodies.person[pairs[:, 0]]], -1)
    for key in keys.unique(dim=0):
        i, part, person = key.tolist()
        if not bool(used[row[i], part]):
            continue
        frames = bodies.frame[pairs[(keys == key).all(-1), 0]].sort().values
        name = "back" if part % 2 else ("seat" if bool(objects.is_seat[i]) else "top")
        times, away = _times(frames, bodies), float(gap[row[i], part])
        found[i].append(TouchingBody(name, part >= 2, person, times, len(frames), away))
    return tuple(tuple(sorted(f, key=lambda t: -t.bodies)) for f in found)


def _gaps(objects: Objects, layout: Layout, contacts: ContactPoints) -> Float[Tensor, "touched 4"]:
    """Mean distance of the contact points from the part that they touch [m]."""
    top, back = (place(r, layout)[contacts.object_of] for r in (objects.top, objects.back))
    parts = torch.stack([top, back, top, back], 1)
    away = torch.cdist(contacts.points, parts).amin(-1)
    return (away * contacts.weight).sum(-1) / contacts.weight.sum(-1).clamp_min(1e-9)


def _times(frames: Int[Tensor, " rows"], bodies: Bodies) -> tuple[tuple[int, int], ...]:
    """First and last frame of every time, longest first."""
    known = bodies.frame.unique()
    step = int(known.diff().median()) if len(known) > 1 else 1
    cut = (frames.diff() > PAUSE * max(step, 1)).nonzero()[:, 0] + 1
    times = [(int(t[0]), int(t[-1])) for t in torch.tensor_split(frames, cut)]
    return tuple(sorted(times, key=lambda t: (t[0] - t[1], t[0])))
