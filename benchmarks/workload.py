"""Ten pieces of furniture with evidence for all terms of Eq. 1, made without a video."""

import torch
from engine import K, bed, chair, mesh, padded, sofa, table
from torch import Tensor

from mover.core.types import Camera, Layout, Objects
from mover.energy.objective import HumanCues, ImageCues
from mover.energy.terms.bbox import SEEN
from mover.energy.terms.collision import BodySpace
from mover.energy.terms.contact import ContactPoints, shares_of
from mover.energy.terms.depth import DepthRange
from mover.geometry.camera import project, tilted, to_camera
from mover.geometry.crops import crop_views
from mover.geometry.placement import place
from mover.geometry.raster import Depths, Topology, look
from mover.geometry.topology import edges_of
from mover.geometry.volume import Volume, grid_around
from mover.stages.objects.place_inputs import PlaceInputs

FLOOR = -1.4
CAMERA = Camera(K, tilted(torch.tensor(-0.2), torch.tensor(0.0)), 640, 360)


def furniture(count: int, n_faces: int, rng: torch.Generator) -> Objects:
    """Chairs, sofas, tables and beds in turn, each standing on the middle of its bottom."""
    kinds = [mesh(k(), n_faces) for k in (chair, sofa, table, bed)]
    meshes = [kinds[i % 4] for i in range(count)]
    verts = padded([v for v, _ in meshes], like_first=True)
    low, high = verts.amin(1), verts.amax(1)
    bottom = torch.stack([low[:, 0] + high[:, 0], 2 * low[:, 1], low[:, 2] + high[:, 2]], -1) / 2
    verts = verts - bottom[:, None]
    number = torch.arange(verts.shape[1])
    real = torch.stack([number < len(v) for v, _ in meshes])

    def some(many: int) -> Tensor:
        picks = [torch.randint(len(v), (many,), generator=rng) for v, _ in meshes]
        return torch.stack([v[p] for v, p in zip(verts, picks, strict=True)])

    names, yes = tuple(str(i) for i in range(count)), torch.ones(count, dtype=torch.bool)
    faces, edges = padded([f for _, f in meshes]), padded([edges_of(f) for _, f in meshes])
    kinds_of = tuple(("chair", "sofa", "table", "bed")[i % 4] for i in range(count))
    samples, top, back = some(1500), some(400), some(400)
    on_floor = torch.full((count,), -1)
    return Objects(
        names, kinds_of, verts, real, faces, edges, samples, high - low, top, back, yes, yes, yes,
        on_floor,
    )  # fmt: skip


def truth(objects: Objects, rng: torch.Generator) -> Layout:
    """Random places before the camera."""
    n = len(objects.ids)
    spot = torch.rand(n, 3, generator=rng) * torch.tensor([2.4, 0.0, 1.6])
    spot = spot + torch.tensor([-1.2, FLOOR, -4.2])
    return Layout(spot, torch.rand(n, generator=rng) * 6.28, torch.zeros(n, 3))


def seen(objects: Objects, layout: Layout, window: int) -> tuple[ImageCues, Depths]:
    """What a perfect detector would say of this layout, and the depths in the windows."""
    cam = to_camera(place(objects.verts, layout), CAMERA.R_cam_world)
    uv = project(cam, K)
    boxes = torch.cat([uv.amin(1), uv.amax(1)], 1)
    views = crop_views(K, boxes, 0.3, window)
    image, found = look(cam, Topology(objects.faces, objects.edges), views)
    assert found is not None
    n = len(boxes)
    sides, keep = torch.full((n, 4), SEEN), torch.ones_like(image).bool()
    return ImageCues(boxes, sides, views, image, keep, torch.ones(n)), found


def people(objects: Objects, layout: Layout, depths: Depths, rng: torch.Generator) -> HumanCues:
    """Bounds on half of each mask, a ball of free space, points near seats and backs."""
    n, (height, width) = len(objects.ids), depths.nearest.shape[-2:]
    left = depths.covered & (torch.arange(width) < 0.4 * width).expand(height, width)
    nowhere = torch.full_like(depths.nearest, torch.inf)
    near = torch.where(left, depths.nearest, -nowhere)
    far = torch.where(depths.covered & ~left, depths.nearest, nowhere)
    empty = grid_around(torch.tensor([-1.5, FLOOR, -5.0]), torch.tensor([1.5, 0.6, -1.0]))
    axes = [
        o + empty.cell * torch.arange(s)
        for o, s in zip(empty.origin, empty.values.shape, strict=True)
    ]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    ball = (grid - torch.tensor([0.0, -0.6, -3.0])).norm(dim=-1) - 0.6
    volume = Volume(ball.clamp(-0.5, 2 * empty.cell), empty.origin, empty.cell)
    weight = torch.ones(n, 4, 300)
    weight[:, 2:, 60:] = 0
    points = place(objects.top, layout)[:, torch.randint(400, (1200,), generator=rng)]
    points = points.view(n, 4, 300, 3) + 0.05 * torch.randn(n, 4, 300, 3, generator=rng)
    facing = torch.stack([layout.yaw.sin(), layout.yaw.cos()], -1)
    bodies, shares = torch.full((n,), 8.0), shares_of(weight)
    touches = ContactPoints(torch.arange(n), points, weight, bodies, shares, facing)
    return HumanCues(DepthRange(near, far, near, torch.ones(n)), BodySpace(volume), touches)


def workload(count: int = 10, n_faces: int = 10000, window: int = 256) -> PlaceInputs:
    """Inputs of the second stage, whose start is a few centimetres off."""
    rng = torch.Generator().manual_seed(0)
    objects = furniture(count, n_faces, rng)
    there = truth(objects, rng)
    image, depths = seen(objects, there, window)
    humans = people(objects, there, depths, rng)
    off = 0.04 * torch.randn(1, count, 3, generator=rng) * torch.tensor([1.0, 0.0, 1.0])
    start = Layout(there.t_world_object + off, there.yaw[None] + 0.05, there.log_scale[None])
    return PlaceInputs(objects, CAMERA, FLOOR, image, humans, start, there.yaw)
