import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.core.types import Layout
from mover.geometry.camera import heading, pitch_roll, tilted, to_camera
from mover.geometry.placement import hit_floor, reproject
from mover.geometry.rotations import rot_y

ANGLE = st.floats(-0.5, 0.5)


@given(ANGLE, ANGLE)
@settings(max_examples=30, deadline=None)
def test_pitch_and_roll_come_back_and_the_world_has_no_heading(pitch, roll):
    R = tilted(torch.tensor(pitch, dtype=torch.float64), torch.tensor(roll, dtype=torch.float64))
    found = pitch_roll(R)
    assert abs(float(found[0]) - pitch) < 1e-9
    assert abs(float(found[1]) - roll) < 1e-9
    assert abs(float(R[2, 0])) < 1e-12
    assert float(R[2, 2]) < 0
    assert abs(float(torch.linalg.det(R)) - 1) < 1e-12


@given(ANGLE, ANGLE, st.floats(-3, 3))
@settings(max_examples=30, deadline=None)
def test_a_heading_is_removed_whatever_it_is(pitch, roll, turn):
    R = tilted(torch.tensor(pitch, dtype=torch.float64), torch.tensor(roll, dtype=torch.float64))
    turned = R @ rot_y(torch.tensor(turn, dtype=torch.float64))
    torch.testing.assert_close(turned @ rot_y(R.new_tensor(heading(turned))).mT, R)


def test_rays_meet_the_floor_where_they_point():
    R = tilted(torch.tensor(-0.3), torch.tensor(0.1))
    place = torch.tensor([[0.5, -1.5, -3.0], [-1.0, -1.5, -2.0]])
    cam = to_camera(place, R)
    torch.testing.assert_close(hit_floor(cam / cam[:, 2:], R, torch.tensor(-1.5)), place)


def test_rays_above_the_horizon_stay_finite():
    R = tilted(torch.tensor(0.0), torch.tensor(0.0))
    found = hit_floor(torch.tensor([[0.1, -0.5, 1.0]]), R, torch.tensor(-1.5))
    assert found.isfinite().all()
    assert float(found[0, 1]) == -1.5


def test_a_new_camera_keeps_box_centres_in_the_camera_frame():
    old, new = (
        tilted(torch.tensor(-0.1), torch.tensor(0.0)),
        tilted(torch.tensor(-0.3), torch.tensor(0.1)),
    )
    layout = Layout(torch.tensor([[0.5, -1.2, -3.0]]), torch.tensor([0.7]), torch.zeros(1, 3))
    heights = torch.tensor([0.8])
    found = reproject(layout, heights, old, new)
    half = torch.tensor([0.0, 0.4, 0.0])
    torch.testing.assert_close(
        to_camera(found.t_world_object + half, new), to_camera(layout.t_world_object + half, old)
    )
    torch.testing.assert_close(reproject(found, heights, new, new).yaw, found.yaw)
