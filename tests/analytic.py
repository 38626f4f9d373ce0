"""A noiseless room of boxes whose evidence is known in closed form."""

import functools
from dataclasses import replace

import torch

from mover.core.types import Camera, Layout, Objects
from mover.energy.human_terms import BodySpace, ContactPoints, DepthRange, shares_of
from mover.energy.image_terms import SEEN, Measured
from mover.energy.objective import HumanCues, ImageCues
from mover.energy.prior_terms import Given, Walls, rears_of
from mover.geometry.camera import project, tilted, to_camera
from mover.geometry.crops import crop_views
from mover.geometry.placement import place
from mover.geometry.raster import Topology, look
from mover.geometry.topology import edges_of
from mover.geometry.volume import Volume
from mover.stages.objects.place_inputs import PlaceInputs

GROUND = -1.4
SIZES = ((0.5, 0.45, 0.5), (1.2, 0.7, 0.8), (0.4, 1.8, 0.9))
PLACES = ((-0.9, GROUND, -2.8), (0.5, GROUND, -3.6), (1.7, GROUND, -4.6))
YAWS = (0.3, -0.5, 0.8)
FACES = torch.tensor([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def box_verts(size):
    """Corners of a box whose bottom is centred at the origin; FACES wind outward."""
    corners = torch.cartesian_prod(
        *(torch.tensor(s, dtype=torch.float64) for s in ((-0.5, 0.5), (0.0, 1.0), (-0.5, 0.5)))
    )
    return corners * torch.tensor(size, dtype=torch.float64)


def grid_on_top(size, n=6):
    u = torch.linspace(-0.45, 0.45, n, dtype=torch.float64)
    x, z = torch.meshgrid(u, u, indexing="ij")
    return torch.stack([x * size[0], torch.full_like(x, size[1]), z * size[2]], -1).flatten(0, 1)


def boxes_of(categories, sizes, dtype=torch.float32):
    """Boxes on the floor, named after their classes; all have tops, stools are seats."""
    n = len(sizes)
    top = torch.stack([grid_on_top(s) for s in sizes]).to(dtype)
    return Objects(
        ids=tuple(categories), categories=tuple(categories),
        verts=torch.stack([box_verts(s) for s in sizes]).to(dtype),
        real_verts=torch.ones(n, 8, dtype=torch.bool), faces=FACES.expand(n, -1, -1).clone(),
        edges=edges_of(FACES).expand(n, -1, -1).clone(), samples=top,
        size=torch.tensor(sizes, dtype=dtype),
        top=top, back=torch.zeros_like(top), has_top=torch.ones(n, dtype=torch.bool),
        has_back=torch.zeros(n, dtype=torch.bool),
        is_seat=torch.tensor([c == "stool" for c in categories]),
        supports=torch.full((n,), -1),
    )  # fmt: skip


@functools.cache
def make_inputs(dtype=torch.float32, size=96):
    """Everything that `place_objects` needs, at the truth."""
    camera = Camera(
        torch.tensor([[500.0, 0, 320], [0, 500.0, 180], [0, 0, 1]], dtype=dtype),
        tilted(torch.tensor(-0.2, dtype=dtype), torch.tensor(0.03, dtype=dtype)), 640, 360,
    )  # fmt: skip
    n, objects = len(SIZES), boxes_of(("stool", "table", "cabinet"), SIZES, dtype)
    places, yaws = (torch.tensor(x, dtype=dtype) for x in (PLACES, YAWS))
    truth = Layout(places, yaws, torch.zeros(n, 3, dtype=dtype))
    image = image_at(objects, truth, camera, size)
    return PlaceInputs(
        objects, camera, GROUND, image, humans_at(objects, truth, camera, image),
        Layout(truth.t_world_object[None], truth.yaw[None], truth.log_scale[None]), truth.yaw,
    )  # fmt: skip


def image_at(objects, layout, camera, size):
    verts = to_camera(place(objects.verts, layout), camera.R_cam_world)
    pixels = project(verts, camera.K)
    boxes = torch.cat([pixels.amin(-2), pixels.amax(-2)], -1)
    views = crop_views(camera.K, boxes, 0.3, size)
    drawn, seen = look(verts, Topology(objects.faces, objects.edges), views, depth=True)
    n = len(boxes)
    keep = torch.ones(n, size, size, dtype=torch.bool)
    return ImageCues(
        boxes, torch.full((n, 4), SEEN), views, drawn, keep, torch.ones(n).to(boxes),
        layout.t_world_object.norm(dim=-1), given=given_at(layout),
        measured=Measured(seen.nearest, torch.full((n,), 0.06).to(verts)),
    )  # fmt: skip


def given_at(layout):
    """Objects are given where they stand, along axes of their own."""
    one = torch.ones_like(layout.yaw)
    return Given(
        layout.t_world_object.norm(dim=-1), layout.yaw, 0.6 * one, 5 * one, layout.yaw,
        torch.zeros_like(layout.log_scale), 60 * torch.ones_like(layout.log_scale),
        torch.zeros_like(layout.log_scale), 1.5 * one,
    )  # fmt: skip


def walls_at(objects, layout):
    """A line along the rear of each object, which constrains the others little."""
    rears = rears_of(layout, objects.size)
    trust = 0.2 + 0.7 * torch.eye(len(objects.ids)).to(rears.out)
    return Walls(rears.out, (rears.ends.mean(-2) * rears.out).sum(-1), trust)


def humans_at(objects, layout, camera, image):
    """Depth limits a hand's breadth off, bodies above the table, touched tops."""
    verts = to_camera(place(objects.verts, layout), camera.R_cam_world)
    _, seen = look(verts, Topology(objects.faces, objects.edges), image.views, depth=True)
    near = torch.where(seen.covered, seen.nearest - 0.1, -torch.inf)
    far = torch.where(seen.covered, seen.nearest + 0.1, torch.inf)
    area = (640 / camera.width * camera.K[0, 0] / image.views.K[:, 0, 0]).square()
    y = GROUND + 0.15 * torch.arange(60) - 0.2
    values = (GROUND + 2.2 - y).clamp(-0.3, 0.3).to(near).expand(40, 40, 60).transpose(1, 2)
    volume = Volume(values.contiguous(), torch.tensor([-3.0, GROUND - 0.2, -6.0]).to(near), 0.15)
    points = place(objects.top, layout)[:2].unsqueeze(1).expand(-1, 4, -1, -1)
    weight = torch.zeros(points.shape[:-1]).to(near)
    weight[:, 0] = 1.0
    heading = torch.stack([layout.yaw[:2].sin(), layout.yaw[:2].cos()], -1)
    touches = ContactPoints(
        torch.tensor([0, 1]), points.contiguous(), weight, torch.tensor([6.0, 6.0]).to(near),
        shares_of(weight), heading, torch.tensor([False, False]),
    )  # fmt: skip
    return HumanCues(DepthRange(near, far, area), BodySpace(volume), touches)


def moved(layout, seed, size):
    g = torch.Generator().manual_seed(seed)

    def noise(x):
        return size * (2 * torch.rand(x.shape, generator=g, dtype=torch.float64).to(x) - 1)

    return replace(
        layout, t_world_object=layout.t_world_object + noise(layout.t_world_object),
        yaw=layout.yaw + noise(layout.yaw), log_scale=layout.log_scale + noise(layout.log_scale),
    )  # fmt: skip


def several(layout, count=3, amount=0.1):
    """Some layouts about one."""
    return Layout.cat(*(moved(layout, seed, amount) for seed in range(count)))
