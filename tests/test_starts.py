import torch

from mover.stages.starts import best_few, choose, spread
from mover.types import Layout


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
