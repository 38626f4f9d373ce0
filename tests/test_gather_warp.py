"""Gathering with Warp kernels: the same as without them, for any number of workers."""

import dataclasses

import numpy as np
import pytest
import torch
import trimesh
from test_volume import around, assert_same, moving_spheres, sphere

from mover.core.types import Bodies, Camera, People
from mover.energy.human_terms import BodyView, DepthMaps, bounds_of, merge
from mover.geometry import volume
from mover.geometry.raster import Crops, layers
from mover.geometry.volume import Volume, grid_around, sample, sample_torch
from mover.stages.config import GatherConfig
from mover.stages.contacts.gather_cues import GatherInputs, depth_bounds
from mover.stages.masks import mask_table
from mover_bench.rooms.render import encode

pytest.importorskip("warp")


def test_a_body_that_cuts_into_itself_is_inside_where_its_parts_overlap() -> None:
    one, faces = sphere([0.0, 0, 0], 0.5, level=3)
    two, _ = sphere([0.4, 0.1, 0], 0.4, level=3)
    verts, both = torch.cat([one, two])[None], torch.cat([faces, faces + len(one)])
    found = assert_same(verts, both, around(verts, 60))
    place = torch.cartesian_prod(*[torch.arange(n) for n in found.shape])
    grid = around(verts, 60)
    at = place * grid.cell + grid.origin
    within = (at.norm(dim=-1) < 0.49) & ((at - torch.tensor([0.4, 0.1, 0])).norm(dim=-1) < 0.39)
    assert (found.flatten()[within] < 0).all()


def test_a_body_that_leaves_the_grid_is_cut_off() -> None:
    verts, faces = sphere([0.0, 0, 0], 0.5)
    whole = grid_around(verts.amin(0), verts.amax(0), cells=40, padding=0.2)
    corner = torch.tensor([10.0, 18, 0])
    part = Volume(whole.values[10:25, 18:39, :13], whole.origin + whole.cell * corner, whole.cell)
    assert (assert_same(verts[None], faces, part) < 0).any()
    away = volume.union_bodies(verts[None] + 9, faces, part, 2).values
    assert torch.equal(away, part.values)


def test_no_frames_leave_the_grid_as_it_was() -> None:
    verts, faces = moving_spheres(2)
    grid = around(verts, 20)
    assert torch.equal(volume.union_bodies(verts[:0], faces, grid, 2).values, grid.values)


@pytest.mark.parametrize("wrong", [torch.inf, torch.nan])
def test_vertices_that_are_not_finite_are_refused_by_their_body(wrong: float) -> None:
    verts, faces = moving_spheres(9)
    grid = around(verts, 20)
    verts[7, 3] = wrong
    with pytest.raises(ValueError, match="body 7"):
        volume.union_bodies(verts, faces, grid, 3)


SETTINGS = GatherConfig(erode=2)


def passing(count: int) -> GatherInputs:
    """A ball that crosses the image (in part outside), its masks too small or shifted."""
    verts, faces = sphere([0.0, 0, 0], 0.4, level=2)
    way = torch.linspace(-1.6, 1.3, count)[:, None] * torch.tensor([1.0, 0.3, 0.2])
    K = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), 80, 60)
    frame, person = torch.arange(count), torch.zeros(count, dtype=torch.long)
    place = way[:, None] + torch.tensor([0.0, 0.0, -2.0])
    bodies = Bodies(verts + place, faces, None, (), frame, person, None, "world", None)
    masks = np.zeros((count, 60, 80), dtype=bool)
    for k in range(count):
        column = int(40 + 40 * float(way[k, 0]))
        masks[k, 18 + k % 5 : 40, max(column - 12, 0) : max(column + 3 * (k % 4), 0)] = True
    people = People(encode(list(masks)), frame, person, {})
    objects = torch.zeros(3, 60, 80, dtype=torch.bool)
    for k in range(3):
        objects[k, 10 + 5 * k : 45, 25 * k : 25 * k + 30] = True
    return GatherInputs(bodies, people, objects, camera)


def test_bounds_are_those_of_whole_images_one_after_another() -> None:
    sight = passing(13)
    table = mask_table(sight.people, sight.bodies)
    blank = torch.full((60, 80), torch.inf)
    expected = DepthMaps(-blank, blank)
    views = Crops(sight.camera.K[None], 60, 80)
    for row, verts in enumerate(sight.bodies.verts):
        cam = verts @ sight.camera.R_cam_world.mT
        drawn = layers(cam[None], sight.bodies.faces, views)
        seen = BodyView(drawn.front[0], drawn.exit[0], *table.decode(row))
        expected = merge(expected, bounds_of(seen, sight.masks, 2))
    for workers in (1, 2, 3):
        found = depth_bounds(sight, SETTINGS, workers)
        for name in ("near", "far"):
            assert getattr(expected, name).isfinite().any()
            assert torch.equal(getattr(found, name), getattr(expected, name))


def test_progress_of_the_bounds_ends_with_all_bodies() -> None:
    seen: list[tuple[int, int]] = []
    sight = passing(9)
    depth_bounds(sight, SETTINGS, 2, lambda done, of: seen.append((done, of)))
    assert seen[-1] == (9, 9)
    others = dataclasses.replace(sight.people, person=sight.people.person + 1)
    unmasked = dataclasses.replace(sight, people=others)
    assert depth_bounds(unmasked, SETTINGS, 2).near.max() == -torch.inf


def some_field(size: tuple[int, int, int]) -> Volume:
    """Random values in one corner, constant elsewhere."""
    values = torch.full(size, 0.5)
    corner = tuple(slice(n // 2) for n in size)
    values[corner] = torch.randn(values[corner].shape, generator=torch.Generator().manual_seed(3))
    return Volume(values, torch.tensor([0.3, -0.2, 1.0]), 0.05)


@pytest.mark.parametrize("size", [(20, 33, 26), (2, 2, 2), (9, 17, 10), (8, 16, 7)])
def test_lookups_and_their_gradients_are_those_of_torch(size: tuple[int, int, int]) -> None:
    field = some_field(size)
    span = field.cell * (torch.tensor(size) - 1)
    share = torch.rand(3, 400, 3, generator=torch.Generator().manual_seed(4)) * 1.4 - 0.2
    points = (field.origin + share * span).requires_grad_()
    weights = torch.randn(3, 400, generator=torch.Generator().manual_seed(5))
    found, exact = sample(field, points), sample_torch(field, points)
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-5)
    slopes = [torch.autograd.grad((v * weights).sum(), points)[0] for v in (found, exact)]
    torch.testing.assert_close(slopes[0], slopes[1], rtol=1e-3, atol=1e-3)
    assert slopes[1].abs().max() > 1


def test_lookups_of_no_points_and_of_points_that_are_no_numbers() -> None:
    field = some_field((9, 9, 9))
    assert sample(field, torch.zeros(2, 0, 3)).shape == (2, 0)
    assert sample(field, torch.full((1, 3), torch.nan)).shape == (1,)


def test_triangles_without_an_area_change_nothing() -> None:
    one, faces = sphere([0.0, 0, 0], 0.5, level=2)
    a, b = one[faces[0, 0]], one[faces[0, 1]]
    tip = one[0] * 1.6  # a needle that stands out of the surface, and a point at its end
    more = torch.stack([a, (a + b) / 2, b, a, one[0], tip, tip, tip])
    extra = torch.tensor([[0, 1, 2], [0, 3, 2], [4, 5, 6], [6, 4, 5], [5, 6, 7], [7, 4, 4]])
    verts, both = torch.cat([one, more])[None], torch.cat([faces, extra + len(one)])
    grid = around(verts, 50)
    found = volume.union_bodies(verts, both, grid, 1).values
    assert torch.equal(found, assert_same(verts, faces, grid))


@pytest.mark.parametrize("level", [None, 0, 2, 4])
def test_meshes_of_any_size_have_the_distances_of_libigl(level: int | None) -> None:
    verts, faces = sphere([0.1, -0.2, 0.3], 0.5, level or 0)
    if level is None:
        shape = trimesh.creation.box((0.41, 0.73, 0.59))
        verts, faces = (torch.from_numpy(x.copy()) for x in (shape.vertices, shape.faces))
    verts = verts.float()
    verts = torch.stack([verts, verts * torch.tensor([1.1, 0.8, 1.0])])
    assert_same(verts, faces, around(verts, 36))
