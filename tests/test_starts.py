import torch
from analytic import box_verts
from hypothesis import given
from hypothesis import strategies as st

from mover.core.types import Layout
from mover.geometry.camera import project, to_camera
from mover.geometry.placement import place
from mover.stages.objects.starts import (
    alike,
    best_few,
    choose,
    piles_of,
    spread,
    spread_distance,
)


def layout_of(yaws, x=None):
    yaw = torch.tensor(yaws).unsqueeze(-1)
    t = torch.zeros(len(yaws), 1, 3)
    if x is not None:
        t[:, 0, 0] = torch.tensor(x)
    return Layout(t, yaw, torch.zeros(len(yaws), 1, 3))


def test_spread_turns_evenly_and_keeps_the_given_start_first():
    found = spread(layout_of([0.3]), 8)
    assert found.yaw.shape == (8, 1)
    assert abs(float(found.yaw[0, 0]) - 0.3) < 1e-6
    steps = torch.sort(found.yaw[:, 0]).values.diff()
    torch.testing.assert_close(steps, torch.full((7,), torch.pi / 4))


def test_the_best_few_really_differ():
    found = best_few(
        layout_of([0.0, 0.1, 2.0, 0.05]), torch.tensor([[1.0], [0.5], [3.0], [0.7]]), 2
    )
    torch.testing.assert_close(found.yaw[:, 0], torch.tensor([0.1, 2.0]))


def test_places_far_apart_are_different_starts():
    found = best_few(layout_of([0.0, 0.0], [0.0, 0.5]), torch.tensor([[1.0], [0.5]]), 2)
    torch.testing.assert_close(found.t_world_object[:, 0, 0], torch.tensor([0.5, 0.0]))


def test_a_tie_goes_to_the_reference_and_a_clear_win_does_not():
    two = layout_of([0.0, torch.pi])
    reference = torch.tensor([0.0])
    assert float(choose(two, torch.tensor([[0.10], [0.09]]), reference, 1.0).yaw) == 0
    assert float(choose(two, torch.tensor([[0.90], [0.09]]), reference, 1.0).yaw) != 0


def test_each_object_chooses_for_itself():
    layout = Layout(
        torch.zeros(2, 2, 3), torch.tensor([[0.0, 0.0], [1.0, 1.0]]), torch.zeros(2, 2, 3)
    )
    found = choose(layout, torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.zeros(2), 0.0)
    assert found.yaw.tolist() == [1.0, 0.0]


class TestDistance:
    LEVEL = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    K = torch.tensor([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])

    def starts(self):
        r = torch.Generator().manual_seed(0)
        t = torch.rand(2, 3, 3, generator=r) * torch.tensor([2.0, 0, -2]) + torch.tensor(
            [-1.0, -1.4, -3]
        )
        yaw = torch.rand(2, 3, generator=r)
        return Layout(t, yaw, 0.2 * torch.rand(2, 3, 3, generator=r))

    def test_the_given_starts_come_first_then_each_share_of_the_distance(self):
        start = self.starts()
        found = spread_distance(start, (0.9, 1.1))
        assert torch.equal(found.t_world_object[:2], start.t_world_object)
        assert torch.equal(found.log_scale[:2], start.log_scale)
        for k, factor in enumerate((0.9, 1.1)):
            part = slice(2 + 2 * k, 4 + 2 * k)
            ratio = found.t_world_object[part] / start.t_world_object
            torch.testing.assert_close(ratio[..., [0, 2]], torch.full((2, 3, 2), factor))
            assert torch.equal(found.t_world_object[part, :, 1], start.t_world_object[..., 1])
            assert torch.equal(found.yaw[part], start.yaw)

    def test_no_shares_no_further_starts(self):
        start = self.starts()
        found = spread_distance(start, ())
        assert torch.equal(found.t_world_object, start.t_world_object)

    def test_before_a_level_camera_columns_and_height_in_the_image_stay(self):
        start = self.starts()
        size = torch.tensor([0.6, 1.1, 0.4])
        verts = (box_verts((1.0, 1.0, 1.0)).float() * size).expand(3, -1, -1)
        axis = torch.tensor([[[0.0, 0, 0], [0, 1.1, 0]]]).expand(3, -1, -1)
        found = spread_distance(start, (0.8, 1.25))

        def seen(points, layout):
            return project(to_camera(place(points, layout), self.LEVEL), self.K)

        corners, ends = seen(verts, found)[..., 0], seen(axis, found)
        tall = ends[..., 0, 1] - ends[..., 1, 1]
        for k in (1, 2):
            part = slice(2 * k, 2 * k + 2)
            torch.testing.assert_close(corners[part], corners[:2], rtol=0, atol=1e-2)
            torch.testing.assert_close(tall[part], tall[:2], rtol=0, atol=1e-2)
            assert (ends[part, :, 0, 1] - ends[:2, :, 0, 1]).abs().min() > 5


@given(st.integers(0, 1000))
def test_starts_are_alike_where_a_whole_pile_begins_alike(seed: int):
    g = torch.Generator().manual_seed(seed)
    supports = torch.tensor([-1, 0, -1, 1])
    number = torch.randint(0, 2, (5, 4), generator=g)
    value = number[..., None].expand(-1, -1, 3).float()
    layout = Layout(value, value[..., 0], value)
    pile = piles_of(supports)
    assert pile.tolist() == [0, 0, 2, 0]
    found = alike(layout, pile)
    for start in range(5):
        for index in range(4):
            mine = [k for k in range(4) if pile[k] == pile[index]]
            same = [s for s in range(5) if torch.equal(number[s, mine], number[start, mine])]
            assert int(found[start, index]) == same[0]
