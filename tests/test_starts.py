"""Starts of the descent: turned, chosen, joined; wall furniture faces the people."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_given import somewhere

from mover.core.types import Layout
from mover.stages.objects import starts


def layout_of(yaws, x=None):
    yaw = torch.tensor(yaws).unsqueeze(-1)
    t = torch.zeros(len(yaws), 1, 3)
    if x is not None:
        t[:, 0, 0] = torch.tensor(x)
    return Layout(t, yaw, torch.zeros(len(yaws), 1, 3))


def test_spread_turns_evenly_and_keeps_the_given_start_first():
    found = starts.spread(layout_of([0.3]), 8)
    assert found.yaw.shape == (8, 1)
    assert abs(float(found.yaw[0, 0]) - 0.3) < 1e-6
    steps = torch.sort(found.yaw[:, 0]).values.diff()
    torch.testing.assert_close(steps, torch.full((7,), torch.pi / 4))


def test_the_best_few_really_differ():
    found = starts.best_few(
        layout_of([0.0, 0.1, 2.0, 0.05]), torch.tensor([[1.0], [0.5], [3.0], [0.7]]), 2
    )
    torch.testing.assert_close(found.yaw[:, 0], torch.tensor([0.1, 2.0]))


def test_an_object_without_evidence_keeps_the_start_that_was_given():
    turned = starts.spread(layout_of([0.1, -0.8]), 24)
    found = starts.best_few(turned, torch.zeros(48, 1), 6)
    assert float(found.yaw[0, 0]) == float(turned.yaw[0, 0])


def test_places_far_apart_are_different_starts():
    found = starts.best_few(layout_of([0.0, 0.0], [0.0, 0.5]), torch.tensor([[1.0], [0.5]]), 2)
    torch.testing.assert_close(found.t_world_object[:, 0, 0], torch.tensor([0.5, 0.0]))


def test_a_tie_goes_to_the_reference_and_a_clear_win_does_not():
    two = layout_of([0.0, torch.pi])
    reference = torch.tensor([0.0])
    assert float(starts.choose(two, torch.tensor([[0.10], [0.09]]), reference, 1.0).yaw) == 0
    assert float(starts.choose(two, torch.tensor([[0.90], [0.09]]), reference, 1.0).yaw) != 0


def test_each_object_chooses_for_itself():
    layout = Layout(
        torch.zeros(2, 2, 3), torch.tensor([[0.0, 0.0], [1.0, 1.0]]), torch.zeros(2, 2, 3)
    )
    found = starts.choose(layout, torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.zeros(2), 0.0)
    assert found.yaw.tolist() == [1.0, 0.0]


def test_layouts_are_joined_indexed_and_chosen_from_object_by_object():
    g = torch.Generator().manual_seed(0)
    one, other = (
        Layout(*(torch.rand(2, 3, *end, generator=g) for end in ((3,), (), (3,)))) for _ in "ab"
    )
    both = Layout.cat(one, other)
    index = torch.tensor([[0, 3, 2]])
    for name in ("t_world_object", "yaw", "log_scale"):
        a, b, c = (getattr(x, name) for x in (one, other, both))
        assert torch.equal(c, torch.cat([a, b]))
        assert torch.equal(getattr(both[1:3], name), c[1:3])
        assert torch.equal(getattr(both[2][None], name)[0], b[0])
        picked = getattr(both.gather(index), name)[0]
        assert torch.equal(picked, torch.stack([a[0, 0], b[1, 1], b[0, 2]]))
        mixed = getattr(Layout.where(torch.tensor([True, False, True]), one, other), name)
        assert torch.equal(mixed, torch.stack([a[:, 0], b[:, 1], a[:, 2]], 1))


@given(st.integers(0, 1000))
def test_starts_are_duplicates_where_a_whole_pile_starts_the_same(seed: int):
    g = torch.Generator().manual_seed(seed)
    supports = torch.tensor([-1, 0, -1, 1])
    number = torch.randint(0, 2, (5, 4), generator=g)
    value = number[..., None].expand(-1, -1, 3).float()
    layout = Layout(value, value[..., 0], value)
    pile = starts.piles_of(supports)
    assert pile.tolist() == [0, 0, 2, 0]
    found = starts.duplicates_of(layout, pile)
    for start in range(5):
        for index in range(4):
            mine = [k for k in range(4) if pile[k] == pile[index]]
            same = [s for s in range(5) if torch.equal(number[s, mine], number[start, mine])]
            assert int(found[start, index]) == same[0]


PEOPLE = torch.tensor([[0.2, -0.5, -2.0], [-0.3, -0.5, -2.2], [0.4, -0.5, -1.5]])
"""Between the camera and an object 4 m before it."""


@pytest.mark.parametrize("given", [-2.9, -1.2, -0.4, 0.0, 0.9, 1.4, 1.9, 3.1])
def test_what_turns_its_back_is_turned_by_quarters_until_it_faces_people(given: float) -> None:
    layout = replace(somewhere(2), yaw=torch.full((2,), given))
    found = starts.turned_to_people(layout, ("cabinet", "chair"), PEOPLE)
    assert float(found.yaw[1]) == pytest.approx(given)  # chairs face anywhere
    turns = float(found.yaw[0] - given) / (math.pi / 2)
    assert turns == pytest.approx(round(turns), abs=1e-5)
    before, after = (float(starts.facing(one, PEOPLE)[0]) for one in (layout, found))
    if before >= -0.25:
        assert float(found.yaw[0]) == pytest.approx(given)  # a side is no back
    else:
        assert after > 0.7
    assert torch.equal(found.t_world_object, layout.t_world_object)


def test_facing_is_the_cosine_of_the_angle_seen_from_above() -> None:
    layout = replace(somewhere(1), t_world_object=torch.tensor([[0.0, -1.0, -4.0]]))
    for yaw in (-2.0, 0.0, 0.7):
        there = torch.tensor([[0.0, 3.0, -1.0]])
        found = starts.facing(replace(layout, yaw=torch.tensor([yaw])), there)
        assert float(found) == pytest.approx(math.cos(yaw), abs=1e-6)


def test_no_people_and_nothing_along_walls_leave_all_as_given() -> None:
    layout = replace(somewhere(1), yaw=torch.tensor([3.1]))
    assert starts.turned_to_people(layout, ("cabinet",), PEOPLE[:0]) is layout
    assert starts.turned_to_people(layout, ("table",), PEOPLE) is layout
