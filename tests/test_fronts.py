"""Wall furniture faces the people."""

import math
from dataclasses import replace

import pytest
import torch
from test_given import somewhere

from mover.stages.objects.starts import facing, turned_to_people

PEOPLE = torch.tensor([[0.2, -0.5, -2.0], [-0.3, -0.5, -2.2], [0.4, -0.5, -1.5]])
"""Between the camera and an object 4 m before it."""


@pytest.mark.parametrize("given", [-2.9, -1.2, -0.4, 0.0, 0.9, 1.4, 1.9, 3.1])
def test_what_turns_its_back_is_turned_by_quarters_until_it_faces_people(given: float) -> None:
    layout = replace(somewhere(2), yaw=torch.full((2,), given))
    found = turned_to_people(layout, ("cabinet", "chair"), PEOPLE)
    assert float(found.yaw[1]) == pytest.approx(given)  # chairs face anywhere
    turns = float(found.yaw[0] - given) / (math.pi / 2)
    assert turns == pytest.approx(round(turns), abs=1e-5)
    before, after = (float(facing(one, PEOPLE)[0]) for one in (layout, found))
    if before >= -0.25:
        assert float(found.yaw[0]) == pytest.approx(given)  # a side is no back
    else:
        assert after > 0.7
    assert torch.equal(found.t_world_object, layout.t_world_object)


def test_facing_is_the_cosine_of_the_angle_seen_from_above() -> None:
    layout = replace(somewhere(1), t_world_object=torch.tensor([[0.0, -1.0, -4.0]]))
    for yaw in (-2.0, 0.0, 0.7):
        there = torch.tensor([[0.0, 3.0, -1.0]])
        found = facing(replace(layout, yaw=torch.tensor([yaw])), there)
        assert float(found) == pytest.approx(math.cos(yaw), abs=1e-6)


def test_nobody_and_nothing_along_walls_leave_all_as_given() -> None:
    layout = replace(somewhere(1), yaw=torch.tensor([3.1]))
    assert turned_to_people(layout, ("cabinet",), PEOPLE[:0]) is layout
    assert turned_to_people(layout, ("table",), PEOPLE) is layout
