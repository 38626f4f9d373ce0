"""The volume of all bodies: signs, distances, and lookups."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from mover.bodies.skinning import open_body, zero_pose
from mover.geometry.nearest import nearest_points, to_surface
from mover.geometry.topology import is_closed
from mover.geometry.volume import (
    Volume,
    grid_around,
    sample,
    signed_distance,
    union_bodies,
    winding,
)


def sphere(center: list[float], radius: float, level: int = 4) -> tuple[Tensor, Tensor]:
    shape = trimesh.creation.icosphere(level)
    verts = torch.from_numpy(shape.vertices.copy()).float() * radius + torch.tensor(center)
    return verts, torch.from_numpy(shape.faces.copy())


def centers(grid: Volume) -> Tensor:
    at = torch.cartesian_prod(*[torch.arange(n) for n in grid.values.shape])
    return at * grid.cell + grid.origin


def test_a_sphere_has_its_analytic_distance_inside_and_near():
    verts, faces = sphere([0.3, -0.2, 1.0], 0.4, level=5)
    grid = grid_around(verts.amin(0), verts.amax(0), cells=60)
    found = union_bodies(verts[None], faces, grid).values.flatten()
    expected = (centers(grid) - torch.tensor([0.3, -0.2, 1.0])).norm(dim=-1) - 0.4
    exact = expected < 1.97 * grid.cell
    torch.testing.assert_close(found[exact], expected[exact], rtol=0, atol=4e-4)
    assert ((found < 0) == (expected < 0)).float().mean() > 0.999
    assert (found[~exact] > 1.9 * grid.cell).all()
    middle = torch.tensor([[0.3, -0.2, 1.0]])
    for wound in (faces, faces.flip(-1)):
        assert signed_distance(middle, verts, wound) < -0.39


def test_columns_through_edges_and_vertices_count_once():
    shape = trimesh.creation.box((4, 4, 4)).subdivide()  # every edge lies on integer columns
    verts = shape.vertices + 4.0
    found = winding(verts, shape.faces, np.array([9, 9, 9]))
    inside = np.zeros((9, 9, 9), dtype=int)
    assert set(np.unique(found)) == {0, 1}
    inside[3:6, 3:6, 3:6] = 1  # strictly inside; on the walls either answer is right
    assert (found[3:6, 3:6, 3:6] == 1).all()
    strictly_out = np.ones((9, 9, 9), dtype=bool)
    strictly_out[2:7, 2:7, 2:7] = False
    assert (found[strictly_out] == 0).all()
    assert found.sum() == 64  # the rule gives each column and each layer to one side


def test_winding_counts_layers_and_holes():
    outer = trimesh.creation.icosphere(3, radius=7.3)
    inner = trimesh.creation.icosphere(3, radius=4.1)
    for turn, value in ((inner.faces, 2), (inner.faces[:, ::-1], 0)):
        verts = np.vstack([outer.vertices, inner.vertices]) + np.array([10.1, 9.9, 10.3])
        faces = np.vstack([outer.faces, turn + len(outer.vertices)])
        found = winding(verts, faces, np.array([20, 20, 20]))
        assert found[10, 10, 10] == value
        assert found[10, 4, 10] == 1
        assert found[10, 1, 10] == 0


def posed_bodies(count: int) -> tuple[Tensor, Tensor]:
    """The open body with bent and twisted limbs."""
    rest = zero_pose(count, open_body())
    angles = 0.3 * torch.randn(rest.body_pose.shape, generator=torch.Generator().manual_seed(0))
    return open_body().posed(replace(rest, body_pose=angles))[0], open_body().faces


def around(verts: Tensor, cells: int) -> Volume:
    return grid_around(verts.amin((0, 1)), verts.amax((0, 1)), cells, padding=0.1)


def assert_same(verts: Tensor, faces: Tensor, grid: Volume) -> Tensor:
    """Signs and, where they are promised, distances are those of libigl."""
    found = union_bodies(verts, faces, grid, 2).values
    each = torch.stack([signed_distance(centers(grid), body, faces) for body in verts])
    exact = each.amin(0).reshape(found.shape)
    same = (found < 0) == (exact < 0)
    assert same.float().mean() > 0.9999
    known = (exact.abs() < 1.999 * grid.cell) | (exact < 0)
    torch.testing.assert_close(found[known & same], exact[known & same], rtol=0, atol=2e-6)
    assert (found[~known] >= 1.998 * grid.cell).all()
    away = found > 2 * grid.cell
    assert torch.equal(found[away], grid.values[away])
    return found


@pytest.mark.slow
def test_posed_bodies_have_the_distances_and_signs_of_libigl():
    verts, faces = posed_bodies(4)
    assert is_closed(faces)
    for body in verts:
        grid = around(body[None], 64)
        assert 0.015 < grid.cell < 0.04
        assert (assert_same(body[None], faces, grid) <= 2 * grid.cell).sum() > 5_000


ROUNDING = 1e-7  # [m]: which of two faces beside an edge is nearest differs by a rounding


def moving_spheres(count: int) -> tuple[Tensor, Tensor]:
    verts, faces = sphere([0, 0, 0], 0.3, level=2)
    steps = torch.linspace(0, 1, count)[:, None, None] * torch.tensor([1.0, 0.2, 0.5])
    return verts + steps, faces


def test_the_union_does_not_depend_on_workers_order_or_batches():
    verts, faces = moving_spheres(12)
    grid = grid_around(verts.amin((0, 1)), verts.amax((0, 1)), cells=50)
    first = union_bodies(verts, faces, grid, workers=1).values
    assert torch.equal(first, union_bodies(verts, faces, grid, workers=4).values)
    same = partial(torch.testing.assert_close, rtol=0, atol=ROUNDING)
    same(first, union_bodies(verts.flip(0), faces, grid).values)
    mixed = faces[torch.randperm(len(faces), generator=torch.Generator().manual_seed(0))]
    for other in (mixed, faces.flip(-1)):
        turned = union_bodies(verts, other, grid).values
        torch.testing.assert_close(turned, first, rtol=0, atol=1e-6)
    half = union_bodies(verts[:5], faces, grid)
    same(first, union_bodies(verts[5:], faces, half).values)
    assert grid.values.min() > 0  # the input is untouched
    alone = [union_bodies(one[None], faces, grid).values for one in verts]
    same(first, torch.stack(alone).amin(0))


def test_progress_is_observed_for_each_body():
    verts, faces = moving_spheres(5)
    seen = []
    grid = grid_around(verts.amin((0, 1)), verts.amax((0, 1)), cells=20)
    union_bodies(verts, faces, grid, observe=lambda done, of: seen.append((done, of)))
    assert seen == [(k, 5) for k in range(1, 6)]


def test_a_grid_holds_its_box_with_cubic_cells():
    low, high = torch.tensor([0.0, -1.0, 2.0]), torch.tensor([3.0, 1.0, 2.5])
    grid = grid_around(low, high, cells=64, padding=0.2)
    assert grid.cell == pytest.approx(3.4 / 64)
    assert grid.values.shape[0] == 64
    ends = grid.origin + grid.cell * (torch.tensor(grid.values.shape) - 1)
    assert (grid.origin - grid.cell / 2 <= low - 0.2 + 1e-5).all()
    assert (ends + grid.cell / 2 >= high + 0.2 - 1e-5).all()
    assert grid.values.min() > 0
    with pytest.raises(ValueError, match="cells"):
        grid_around(high, low)


def linear_field() -> Volume:
    slope = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    at = torch.cartesian_prod(*[torch.arange(n) for n in (5, 6, 7)]).double()
    values = ((at * 0.1 + 1) * slope).sum(-1).reshape(5, 6, 7)
    return Volume(values, torch.ones(3, dtype=torch.float64), 0.1)


def test_a_linear_field_is_reproduced_between_cell_centres():
    volume = linear_field()
    size = torch.tensor([0.4, 0.5, 0.6], dtype=torch.float64)
    points = 1 + size * torch.rand(
        4, 9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    expected = points @ torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    torch.testing.assert_close(sample(volume, points), expected)
    corner = sample(volume, volume.origin + 0.1 * torch.tensor([[2.0, 3, 4]]).double())
    torch.testing.assert_close(corner, volume.values[2, 3, 4][None])


def test_lookup_has_the_gradient_of_finite_differences():
    generator = torch.Generator().manual_seed(1)
    field = Volume(torch.randn(5, 6, 7, generator=generator).double(), torch.zeros(3), 0.1)
    points = 0.1 + 0.2 * torch.rand(8, 3, generator=generator, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: sample(field, x), points.requires_grad_())


def test_outside_of_the_grid_nothing_is_inside_and_nothing_pulls():
    field = Volume(torch.full((4, 4, 4), -1.0), torch.zeros(3), 0.1)
    points = torch.tensor(
        [[0.15, 0.15, 0.15], [0.15, 0.15, 0.31], [-5.0, 0.1, 9.0]], requires_grad=True
    )
    values = sample(field, points)
    values.sum().backward()
    assert values.tolist() == [-1.0, 0.0, 0.0]
    assert torch.equal(points.grad, torch.zeros(3, 3))


def test_nearest_points_and_distances_are_those_of_naive_loops():
    generator = torch.Generator().manual_seed(2)
    query, points = torch.rand(40, 3, generator=generator), torch.rand(60, 3, generator=generator)
    distance, index = nearest_points(query, points)
    naive = torch.cdist(query, points)
    assert torch.equal(index, naive.argmin(1))
    torch.testing.assert_close(distance, naive.amin(1), rtol=0, atol=1e-4)
    both = torch.stack([query, query[:, [1, 2, 0]]])[None], torch.stack([points] * 2)[None]
    assert torch.equal(nearest_points(*both)[1], torch.cdist(*both).argmin(-1))
    verts, faces = sphere([0.0, 0.0, 0.0], 1.0, level=5)
    found = to_surface(query * 3, verts, faces)
    torch.testing.assert_close(found, (query.norm(dim=-1) * 3 - 1).abs(), rtol=0, atol=2e-3)
    assert to_surface(query[:0], verts, faces).shape == (0,)
    with pytest.raises(ValueError, match="empty"):
        nearest_points(query, points[:0])
    with pytest.raises(ValueError, match="empty"):
        to_surface(query, verts, faces[:0])


def test_a_grid_in_double_precision_is_measured_in_single():
    verts, faces = moving_spheres(2)
    grid = grid_around(verts.amin((0, 1)), verts.amax((0, 1)), cells=20)
    double = Volume(grid.values.double(), grid.origin.double(), grid.cell)
    found = union_bodies(verts.double(), faces, double).values
    assert found.dtype == torch.float64
    assert torch.equal(found, union_bodies(verts, faces, grid).values.double())
