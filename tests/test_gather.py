import itertools
from dataclasses import replace

import pytest
import torch

from mover.energy.human_terms import BodyView, DepthMaps, bounds_of, merge
from mover.stages.contacts.assign_contacts import in_turns, thin

H, W = 12, 20
NOTHING = torch.zeros(H, W, dtype=torch.bool)


def seen(visible, others=None):
    """A slab from 2.0 to 2.3 m deep that covers columns 4 to 15."""
    covered = torch.zeros(H, W, dtype=torch.bool)
    covered[:, 4:16] = True
    far = torch.full((H, W), float("inf"))
    front = torch.where(covered, torch.tensor(2.0), far)
    exit_ = torch.where(covered, torch.tensor(2.3), -far)
    return BodyView(front, exit_, visible, NOTHING if others is None else others)


def columns(first, last):
    mask = torch.zeros(H, W, dtype=torch.bool)
    mask[:, first:last] = True
    return mask


def test_an_object_behind_a_seen_person_is_not_nearer_than_where_the_ray_leaves_the_body():
    found = bounds_of(seen(columns(4, 16)), columns(6, 12)[None], 1)
    assert (found.near[:, 6:12] == torch.tensor(2.3)).all()
    assert found.near[:, :6].max() == float("-inf")
    assert not found.far.isfinite().any()


def test_an_object_that_hides_a_person_is_not_farther_than_where_the_ray_enters_the_body():
    found = bounds_of(seen(NOTHING), columns(6, 12)[None], 1)
    assert (found.far[:, 6:12] == 2.0).all()
    assert not found.near.isfinite().any()


def test_rays_that_graze_the_body_bound_nothing():
    found = bounds_of(seen(columns(4, 16)), columns(0, 20)[None], 2)
    assert found.near[:, 4:6].max() == float("-inf")
    assert found.near[:, 14:16].max() == float("-inf")
    assert (found.near[:, 6:14] == torch.tensor(2.3)).all()


def test_one_person_hidden_by_another_says_nothing_about_the_furniture():
    found = bounds_of(seen(NOTHING, columns(0, 20)), columns(6, 12)[None], 1)
    assert not found.far.isfinite().any()


def test_the_vote_keeps_the_larger_region_of_each_object():
    objects = torch.stack([columns(5, 11), columns(11, 15)])
    half = seen(columns(4, 10))  # the rest of the body is hidden
    voted = bounds_of(half, objects, 0)
    assert voted.near[:, 5:10].isfinite().all()
    assert not voted.far[:, 10].isfinite().any()
    assert voted.far[:, 11:15].isfinite().all()


def test_frames_narrow_one_another_in_any_order():
    g = torch.Generator().manual_seed(0)
    maps = [DepthMaps(*torch.rand(2, 4, 5, generator=g).unbind()) for _ in range(3)]
    one, other = merge(merge(maps[0], maps[1]), maps[2]), merge(maps[2], merge(maps[1], maps[0]))
    for name in ("near", "far"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    assert torch.equal(one.near, torch.stack([m.near for m in maps]).amax(0))
    assert torch.equal(one.far, torch.stack([m.far for m in maps]).amin(0))


def test_thinning_keeps_every_weight_and_does_not_grow_with_the_video():
    g = torch.Generator().manual_seed(1)
    cloud = torch.rand(200, 3, generator=g) * 0.1
    once = thin(cloud, torch.zeros(200, dtype=torch.long), 1, (0.02, 500))
    many = thin(cloud.repeat(50, 1), torch.zeros(10_000, dtype=torch.long), 1, (0.02, 500))
    assert once[0].shape == many[0].shape
    assert float(many[1].sum()) == pytest.approx(10_000)
    torch.testing.assert_close(once[0], many[0], atol=1e-5, rtol=0)
    few = thin(cloud, torch.zeros(200, dtype=torch.long), 1, (0.02, 7))
    assert few[0].shape[1] == 7
    assert float(few[1].sum()) == pytest.approx(200)
    middle = (once[0][0] * once[1][0][:, None]).sum(0) / 200
    torch.testing.assert_close(middle, cloud.mean(0), atol=1e-5, rtol=0)


def test_what_a_wrong_outline_explains_is_not_hidden():
    thin_strip = columns(4, 14)  # two of the twelve columns of the body are not seen
    found = bounds_of(replace(seen(thin_strip), reach=2.0), columns(0, 20)[None], 0)
    assert not found.far.isfinite().any()
    found = bounds_of(replace(seen(NOTHING), reach=2.0), columns(0, 20)[None], 0)
    assert (found.far[:, 6:14] == 2.0).all()
    assert not found.far[:, [4, 15]].isfinite().any()


@pytest.mark.parametrize("count", [1, 2, 7, 150, 1000])
def test_every_beginning_of_an_order_in_turns_is_spread_evenly(count):
    order = in_turns(count)
    assert sorted(order.tolist()) == list(range(count))
    for some in range(1, count + 1, max(1, count // 20)):
        places = [-1, *sorted(order[:some].tolist()), count]
        gaps = [b - a for a, b in itertools.pairwise(places)]
        assert max(gaps) <= 1 + 2 * count / some
