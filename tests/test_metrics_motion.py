"""Sliding, floating and jerky people in closed form."""

from dataclasses import replace

import pytest
import torch
from figures import ARMS_DOWN, moving, people, pose

from mover.bodies.parts import members, parts_of
from mover.evaluate.bodies import (
    acceleration_error,
    float_height,
    foot_skate,
    gather_gait,
    jerk,
    sink_depth,
)


def standing(count=4, fps=5.0):
    return people(pose(ARMS_DOWN, count), fps)


def test_who_stands_still_on_the_floor_neither_slides_nor_floats():
    gait = gather_gait(standing(), None, 0.0)
    assert foot_skate(gait) == 0
    assert float_height(gait) == pytest.approx(0, abs=2e-3)
    assert acceleration_error(gait) is None


def test_who_glides_slides_at_that_speed_less_the_higher_they_are():
    slide = moving(standing(), 0.1, 0.0, 0.0)
    low, half, high = (foot_skate(gather_gait(slide, None, g)) for g in (0.0, -0.05, -0.2))
    assert low == pytest.approx(0.5, rel=1e-3)
    assert half == pytest.approx(0.5, rel=1e-3)
    assert high == 0


def test_a_swinging_foot_is_not_sliding():
    bodies = standing()
    left = members(parts_of(bodies), "left_sole")
    verts = bodies.verts.clone()
    verts[:, left, 2] += torch.arange(4)[:, None] * 0.2
    assert foot_skate(gather_gait(replace(bodies, verts=verts), None, 0.0)) == 0


def test_who_is_lifted_floats():
    up = replace(standing(), verts=standing().verts + torch.tensor([0.0, 0.07, 0.0]))
    assert float_height(gather_gait(up, None, 0.0)) == pytest.approx(0.07, abs=2e-3)
    assert float_height(gather_gait(up, None, 0.2)) == 0
    assert float_height(gather_gait(up, None, None)) is None


@pytest.mark.parametrize("frames", [[0, 1, 2, 3], [0, 1, 3, 4]])
def test_constant_acceleration_is_measured_at_real_times(frames):
    frame = torch.tensor(frames)
    time = frame / 5.0
    joints = torch.zeros(4, 22, 3)
    names = tuple(f"joint_{k}" for k in range(22))
    true = replace(standing(), joints=joints, joint_names=names, frame=frame)
    fall = replace(true, joints=joints + torch.tensor([0.0, -4.9, 0.0]) * time[:, None, None] ** 2)
    found = acceleration_error(gather_gait(fall, true, 0.0))
    assert found == pytest.approx(9.8, rel=1e-3)
    assert acceleration_error(gather_gait(true, true, 0.0)) == 0


def test_who_stands_in_the_floor_sinks_as_deep():
    down = replace(standing(), verts=standing().verts - torch.tensor([0.0, 0.05, 0.0]))
    assert sink_depth(gather_gait(down, None, 0.0)) == pytest.approx(0.05, abs=2e-3)
    assert sink_depth(gather_gait(down, None, -0.1)) == 0
    assert sink_depth(gather_gait(down, None, None)) is None


@pytest.mark.parametrize("frames", [[0, 1, 2, 3], [0, 1, 3, 4]])
def test_constant_jerk_is_measured_at_real_times(frames):
    time = torch.tensor(frames) / 5.0
    names = tuple(f"joint_{k}" for k in range(22))
    still = replace(
        standing(), joints=torch.zeros(4, 22, 3), joint_names=names, frame=torch.tensor(frames)
    )
    way = torch.tensor([0.5, 0.0, 0.0]) * time[:, None, None] ** 3
    moves = replace(still, joints=still.joints + way)
    assert jerk(gather_gait(moves, None, 0.0)) == pytest.approx(3.0, rel=1e-3)
    assert jerk(gather_gait(still, None, 0.0)) == 0
    short = replace(
        moves, verts=moves.verts[:3], joints=moves.joints[:3], frame=moves.frame[:3],
        person=moves.person[:3], pose=None,
    )  # fmt: skip
    assert jerk(gather_gait(short, None, 0.0)) is None


def test_unordered_images_have_no_motion():
    gait = gather_gait(standing(fps=None), None, 0.0)
    assert foot_skate(gait) is None
    assert float_height(gait) is not None
