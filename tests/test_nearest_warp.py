"""Nearest points of scaled clouds against all distances and SciPy's tree."""

import pytest
import torch
from nearest_torch import nearest_torch
from scipy.spatial import KDTree

from mover.geometry.nearest_warp import FAN, clouds, nearest

pytest.importorskip("warp")


@pytest.mark.parametrize("count", [1, 7, 8, 9, 63, 65, 500, 1001])
def test_found_points_are_as_near_as_the_nearest(count: int) -> None:
    g = torch.Generator().manual_seed(count)
    points = torch.rand(3, count, 3, generator=g) * torch.tensor([1.0, 0.2, 2.0])
    query = torch.rand(2, 3, 40, 3, generator=g) * 3 - 1
    scale = 0.3 + torch.rand(2, 3, 3, generator=g)
    held = clouds(points)
    placed = points * scale.unsqueeze(-2)
    for method in (nearest, nearest_torch):
        index = method(held, query, scale)
        near = placed.gather(-2, index.unsqueeze(-1).expand(-1, -1, -1, 3))
        distance = (near - query).norm(dim=-1)
        for start in range(2):
            for k in range(3):
                exact, _ = KDTree(placed[start, k].numpy()).query(query[start, k].numpy())
                torch.testing.assert_close(
                    distance[start, k], torch.from_numpy(exact).float(), rtol=0, atol=1e-5
                )


def test_boxes_hold_their_points_and_every_point_is_kept() -> None:
    points = torch.randn(2, 77, 3, generator=torch.Generator().manual_seed(0))
    held = clouds(points)
    for k in range(2):
        assert sorted(held.index[k].tolist()) == list(range(77))
        assert torch.equal(held.points[k], points[k, held.index[k]])
        for box, part in enumerate(held.points[k].split(FAN)):
            assert torch.equal(part.amin(0), held.boxes[k, 0, box])
            assert torch.equal(part.amax(0), held.boxes[k, 1, box])


def test_of_points_equally_near_the_first_is_found() -> None:
    points = torch.zeros(1, 20, 3)
    found = nearest(clouds(points), torch.ones(1, 5, 3), torch.ones(1, 3))
    assert found.unique().tolist() == [0]


def test_no_queries_find_nothing_and_no_points_are_refused() -> None:
    held = clouds(torch.rand(2, 9, 3, generator=torch.Generator().manual_seed(0)))
    assert nearest(held, torch.zeros(4, 2, 0, 3), torch.ones(4, 2, 3)).shape == (4, 2, 0)
    with pytest.raises(ValueError, match="no points"):
        clouds(torch.zeros(2, 0, 3))
