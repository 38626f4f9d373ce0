import random

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from mover.core.devices import lstsq
from mover.geometry.crops import (
    area_mean,
    crop_views,
    depth_in,
    grid_in_image,
    regions,
    sample_nearest,
    share_inside,
)

K = torch.tensor([[300.0, 0, 32], [0, 310.0, 24], [0, 0, 1]])


def test_the_mean_over_a_window_pixel_equals_that_of_a_fine_naive_sampling():
    g = torch.Generator().manual_seed(0)
    image = torch.rand(48, 64, generator=g) > 0.5
    box = torch.tensor([[10.3, 5.7, 40.1, 30.9]])
    views = crop_views(K, box, 0.3, 8)
    x, y = grid_in_image(views, K)
    at = regions(torch.tensor([[25.2, 18.3]]), torch.tensor([19.6]), (48, 64))
    found = area_mean([image[at[0]]], at, views, K)[0]
    inner = share_inside(views, K, (48, 64))[0]
    n = 400
    for row, column in ((0, 0), (3, 5), (7, 7), (2, 6)):
        xs = torch.linspace(0, 1, n + 1)[:-1] + 0.5 / n
        u = (x[0, column] + xs * (x[0, column + 1] - x[0, column])).floor().long()
        v = (y[0, row] + xs * (y[0, row + 1] - y[0, row])).floor().long()
        inside = ((v >= 0) & (v < 48)).unsqueeze(1) & ((u >= 0) & (u < 64))
        values = image[v.clamp(0, 47)][:, u.clamp(0, 63)].float() * inside
        assert abs(float(found[row, column]) - float(values.mean())) < 0.01
        assert abs(float(inner[row, column]) - float(inside.float().mean())) < 0.01


def test_a_window_sees_a_point_where_its_intrinsics_say():
    views = crop_views(K, torch.tensor([[10.0, 5.0, 40.0, 30.0]]), 0.3, 32)
    x, y = grid_in_image(views, K)
    point = torch.tensor([-0.02, 0.01, 1.0])
    u, v, _ = (K @ point).tolist()
    wu, wv, _ = (views.K[0] @ point).tolist()
    step = float(x[0, 1] - x[0, 0])
    assert abs(float(x[0, 0]) + wu * step - u) < 1e-3
    assert abs(float(y[0, 0]) + wv * step - v) < 1e-3


def test_beyond_the_image_the_mean_is_zero_and_the_sample_is_the_given_value():
    box = torch.tensor([[50.0, 30.0, 90.0, 60.0]])
    views = crop_views(K, box, 0.3, 16)
    at = regions(torch.tensor([[70.0, 45.0]]), torch.tensor([27.0]), (48, 64))
    inside = torch.ones(48, 64, dtype=torch.bool)[at[0]]
    assert float(area_mean([inside], at, views, K)[0, -1, -1]) == 0
    found = sample_nearest(torch.ones(48, 64), views, K, float("-inf"))
    assert found[0, -1, -1] == float("-inf")
    assert found[0, 2, 2] == 1


def test_a_region_holds_its_square_as_far_as_it_lies_in_the_image():
    center = torch.tensor([[25.2, 18.3], [-90.0, -80.0], [300.0, 30.0], [32.0, 24.0]])
    reach = torch.tensor([19.6, 7.0, 12.5, 500.0])
    at = regions(center, reach, (48, 64))
    assert at[0] == (slice(0, 38), slice(5, 45))
    assert at[1:3] == [(slice(0, 2), slice(0, 2)), (slice(17, 43), slice(62, 64))]
    assert at[3] == (slice(0, 48), slice(0, 64))


def test_distances_in_a_mask_are_exact_to_the_last_bit():
    """Rounding that depends on where a picture lies in memory moved a whole room by 9 mm."""
    rng = np.random.default_rng(0)
    for share in np.geomspace(1e-3, 0.5, 20):
        mask = rng.random((90, 131)) > share
        exact = distance_transform_edt(mask).astype(np.float32)
        assert np.array_equal(depth_in(mask), exact)


def test_least_squares_gives_the_same_bits_wherever_memory_was_used_before():
    """As the pivots do not with the default driver of torch.linalg.lstsq."""
    rows = torch.Generator().manual_seed(0)
    left, right = (torch.randn(13, n, generator=rows).double() for n in (3, 7))
    expected = torch.from_numpy(np.linalg.lstsq(left.numpy(), right.numpy(), rcond=None)[0])
    used, found = [], set()
    for _ in range(1000):
        used.append(bytearray(random.randint(1, 5000)))
        used = used[-50:]
        found.add(lstsq(left, right).numpy().tobytes())
    assert len(found) == 1
    assert torch.allclose(lstsq(left, right), expected, atol=1e-12)
    assert torch.allclose(lstsq(left, right[:, 0]), expected[:, 0], atol=1e-12)
