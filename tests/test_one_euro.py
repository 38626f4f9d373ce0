"""The One-Euro filter, and wrong frames that are left out of a fit."""

import dataclasses

import numpy as np
import pytest
import torch
from make_keypoints import as_bodies, seen, walker

from mover.core.records import rows_of
from mover.fitting.one_euro import OneEuroConfig, one_euro, smooth_bodies, smooth_keypoints
from mover.stages.people.select_frames import SelectInputs, select_frames


def naive(x, t, config):
    """The algorithm of the publication, number by number, at any times."""

    def alpha(cut, h):
        return 1 / (1 + 1 / (2 * np.pi * cut * h))

    out, speed = [x[0]], 0.0
    for k in range(1, len(x)):
        h = t[k] - t[k - 1]
        a = alpha(config.derivative, h)
        speed = a * (x[k] - x[k - 1]) / h + (1 - a) * speed
        a = alpha(config.least + config.beta * abs(speed), h)
        out.append(a * x[k] + (1 - a) * out[-1])
    return np.array(out)


def column(x):
    return torch.tensor(x).reshape(-1, 1, 1)


def test_the_filter_equals_the_publication_at_uneven_times():
    rng = np.random.default_rng(0)
    t, x = np.cumsum(rng.uniform(0.02, 0.2, 60)), np.cumsum(rng.normal(size=60))
    config = OneEuroConfig(0.8, 0.3)
    found = one_euro(column(x), torch.tensor(t), torch.ones(60, 1, dtype=torch.bool), config)
    np.testing.assert_allclose(found[:, 0, 0].numpy(), naive(x, t, config), atol=1e-12)


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_trembling_of_what_stands_still_goes_down(fps):
    rng, n = np.random.default_rng(1), int(20 * fps)
    x = 3.0 * rng.normal(size=n)
    there = torch.ones(n, 1, dtype=torch.bool)
    config = OneEuroConfig(0.3, 0.0)
    found = one_euro(column(x), torch.arange(n) / fps, there, config)[:, 0, 0].numpy()
    assert found[n // 4 :].std() < 0.6 * x[n // 4 :].std()


def test_missing_values_are_passed_over_and_long_gaps_begin_anew():
    x = np.array([0.0, 0.0, 99.0, 0.0, 10.0, 10.0])
    t = torch.tensor([0.0, 0.1, 0.2, 0.3, 9.0, 9.1]).double()
    there = torch.tensor([1, 1, 0, 1, 1, 1], dtype=torch.bool)[:, None]
    found = one_euro(column(x), t, there, OneEuroConfig())[:, 0, 0]
    assert found.tolist() == [0, 0, 99, 0, 10, 10]


def test_keypoints_are_filtered_track_by_track_and_images_are_not():
    walk = as_bodies(*walker(20, fps=30.0), fps=30.0)
    clean, noisy = seen(walk), seen(walk, noise=3.0, missing=0.1)
    smooth = smooth_keypoints(noisy)
    there = noisy.confidence > 0

    def tremble(points):
        second = (points - clean.points).diff(n=2, dim=0)
        return second[there[:-2] & there[1:-1] & there[2:]].norm(dim=-1).mean()

    assert tremble(smooth.points) < 0.6 * tremble(noisy.points)
    assert torch.equal(smooth.points[~there], noisy.points[~there])
    images = dataclasses.replace(noisy, fps=None)
    assert torch.equal(smooth_keypoints(images).points, noisy.points)


def test_filtered_bodies_move_as_wholes_with_their_parameters():
    walk = as_bodies(*walker(10))
    shaken = walk.pose.transl + 0.03 * torch.randn(
        10, 3, generator=torch.Generator().manual_seed(0)
    )
    bodies = as_bodies(dataclasses.replace(walk.pose, transl=shaken), walk.frame)
    smooth = smooth_bodies(bodies, OneEuroConfig(1.0, 0.5))
    again = as_bodies(smooth.pose, walk.frame)
    torch.testing.assert_close(again.verts, smooth.verts, atol=1e-5, rtol=0)
    shift = smooth.joints - bodies.joints
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift), atol=1e-6, rtol=0)


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_bodies_that_jump_are_dropped_by_the_filter_of_the_pipeline(fps):
    pose, frame = walker(30, fps=fps)
    wrong = [7, 16, 17]
    transl = pose.transl.clone()
    transl[wrong] += torch.tensor([0.0, 0.0, 0.8])
    bodies = as_bodies(dataclasses.replace(pose, transl=transl), frame, fps)
    keep = select_frames(SelectInputs(bodies)).keep
    left = rows_of(bodies, keep)
    assert sorted(set(range(30)) - set(left.frame.tolist())) == wrong
    images = dataclasses.replace(bodies, fps=None)
    assert select_frames(SelectInputs(images)).keep.all()
