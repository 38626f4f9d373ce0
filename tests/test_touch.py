from dataclasses import replace

import pytest
import torch
from figures import ARMS_DOWN, ARMS_UP, AT_TABLE, SEATED, STRIDE, moving, people, pose, turned
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.bodies.parts import members, parts_of
from mover.bodies.posture import headings, postures, touching
from mover.bodies.skinning import open_body
from mover.geometry.rotations import rot_y

LEANING = {**SEATED, **{f"{s}_hip": (-1.2, 0.0, 0.0) for s in ("left", "right")}}


def chance(bodies, *names: str, ground: float = 0.0):
    """Share of a part that touches, for each body."""
    parts = parts_of(bodies)
    return touching(bodies, parts, ground)[:, members(parts, *names)].mean(1)


def posture(bodies, ground: float | None = 0.0) -> list[str]:
    found = postures(bodies, parts_of(bodies), ground)
    kinds = {"standing": found.standing, "sitting": found.sitting, "lying": found.lying}
    rows = [[k for k, v in kinds.items() if v[i]] for i in range(len(bodies.verts))]
    return ["/".join(row) for row in rows]


def test_standing_feet_touch_and_nothing_else():
    bodies = people(pose(ARMS_DOWN))
    assert posture(bodies) == ["standing"]
    assert chance(bodies, "left_sole", "right_sole") > 0.95
    soles = members(parts_of(bodies), "left_sole", "right_sole")
    assert touching(bodies, parts_of(bodies), 0.0)[:, ~soles].max() == 0


def test_lifted_foot_does_not_touch():
    bodies = people(pose({**ARMS_DOWN, "left_hip": (-0.9, 0, 0), "left_knee": (0.9, 0, 0)}))
    assert chance(bodies, "left_sole") == 0
    assert chance(bodies, "right_sole") > 0.95


def test_sitter_touches_with_seat_and_thighs_that_face_down():
    bodies = people(pose(SEATED))
    parts = parts_of(bodies)
    found = touching(bodies, parts, 0.0)[0]
    assert posture(bodies) == ["sitting"]
    assert chance(bodies, "left_thigh", "right_thigh") > 0.6
    assert chance(bodies, "back") == 0
    sure = (found > 0.5) & members(parts, "seat", "left_thigh", "right_thigh")
    height = bodies.verts[0, :, 1]
    assert sure.sum() > 100
    assert height[sure].max() - height[sure].min() < 0.15
    lowest = height[members(parts, "seat")].min()
    assert height[sure].min() < lowest + 0.01


def test_walker_touches_with_soles_only():
    bodies = moving(people(pose(STRIDE, 6), fps=30.0), 0.0, 0.0, 0.04)
    assert chance(bodies, "seat", "back", "left_thigh", "right_thigh").max() == 0
    assert set(posture(bodies)) == {"standing"}


def test_sole_that_slides_does_not_touch():
    still = people(pose(ARMS_DOWN, 4), fps=30.0)
    assert chance(still, "left_sole").min() > 0.95
    assert chance(moving(still, 0.0, 0.0, 0.03), "left_sole").max() == 0


def test_sitting_down_is_not_yet_sitting():
    falling = moving(people(pose(SEATED, 5), fps=30.0), 0.0, -0.02, 0.0)
    assert set(posture(falling)) == {""}
    assert set(posture(replace(falling, fps=None))) == {"sitting"}


def test_speed_is_taken_within_a_track_and_over_real_time():
    alone = people(pose(SEATED, 4), fps=30.0)
    far = alone.verts + torch.tensor([[[0.0, 0, 0]], [[1, 0, 0]]]).repeat_interleave(2, 0)
    two = replace(alone, verts=far, person=torch.tensor([0, 0, 1, 1]))
    assert set(posture(two)) == {"sitting"}
    assert set(posture(replace(two, person=torch.zeros(4).long()))) == {""}
    late = replace(two, person=torch.zeros(4).long(), frame=torch.arange(4) * 90)
    assert set(posture(late)) == {"sitting"}
    shuffled = torch.tensor([2, 0, 3, 1])
    mixed = moving(alone, 0.0, 0.0, 0.05)
    mixed = replace(mixed, verts=mixed.verts[shuffled], frame=mixed.frame[shuffled])
    assert set(posture(mixed)) == {""}


def test_trembling_by_a_centimetre_is_still_sitting():
    still = people(pose(SEATED, 12), fps=30.0)
    generator = torch.Generator().manual_seed(0)
    shake = 0.006 * torch.randn(12, 1, 3, generator=generator)
    assert set(posture(replace(still, verts=still.verts + shake))) == {"sitting"}


def test_back_touches_when_a_sitter_leans_back_only():
    back = people(turned(pose(LEANING), -0.35, 0.0, 0.0))
    forward = people(
        turned(
            pose({**LEANING, "left_hip": (-1.9, 0, 0), "right_hip": (-1.9, 0, 0)}), 0.3, 0.0, 0.0
        )
    )
    assert posture(back) == posture(forward) == ["sitting"]
    assert chance(back, "back") > 0.6
    assert chance(forward, "back") == 0
    assert postures(back, parts_of(back), 0.0).recline == pytest.approx(0.35, abs=0.06)


def test_lying_touches_with_what_is_below():
    supine = people(turned(pose(ARMS_DOWN), -1.57, 0.0, 0.0), floor=0.5)
    prone = people(turned(pose(ARMS_DOWN), 1.57, 0.0, 0.0), floor=0.5)
    assert posture(supine) == posture(prone) == ["lying"]
    assert chance(supine, "back") > 0.7
    assert chance(prone, "back", "seat") == 0
    found = touching(prone, parts_of(prone), 0.0)[0] > 0.5
    assert found.sum() > 100
    assert prone.verts[0, found, 1].max() < 0.6


def test_hand_at_rest_on_a_table_touches_with_its_palm():
    at_table = people(pose(AT_TABLE, 3), fps=30.0)
    turn = {"left_shoulder": (1.57, 0.0, -1.2), "left_elbow": (0.0, -1.5, 0.0)}
    palm_up = people(pose({**AT_TABLE, **turn}, 3), fps=30.0)
    parts = parts_of(at_table)
    palm = touching(at_table, parts, 0.0)[:, members(parts, "right_palm")]
    assert palm.amax(1).min() > 0.5  # what reaches lowest touches a flat surface
    assert chance(palm_up, "left_palm").max() < 0.05
    waving = moving(at_table, 0.0, 0.0, 0.02)
    assert chance(waving, "right_palm").max() == 0
    assert chance(people(pose(ARMS_UP)), "left_palm", "right_palm") == 0


def test_hand_on_the_own_lap_does_not_touch_a_table():
    lap = {"left_shoulder": (0.0, -0.5, -1.25), "left_elbow": (0.0, -0.9, 0.0)}
    bodies = people(pose({**SEATED, **lap}))
    parts = parts_of(bodies)
    palm = bodies.verts[0, members(parts, "left_palm")].mean(0)
    thigh = bodies.verts[0, members(parts, "left_thigh")].mean(0)
    assert (palm - thigh).norm() < 0.25
    assert chance(bodies, "left_palm") == 0


@settings(max_examples=8, deadline=None)
@given(yaw=st.floats(-3.1, 3.1), x=st.floats(-3, 3), z=st.floats(-5, -1))
def test_touch_ignores_place_and_heading_and_headings_follow(yaw, x, z):
    bodies = people(pose(SEATED))
    R = rot_y(torch.tensor(yaw))
    moved = replace(bodies, verts=bodies.verts @ R.T + torch.tensor([x, 0.0, z]))
    parts = parts_of(bodies)
    torch.testing.assert_close(
        touching(moved, parts, 0.0), touching(bodies, parts, 0.0), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(
        headings(moved, parts)[0], R @ torch.tensor([0.0, 0, 1]), atol=0.03, rtol=0
    )


def test_only_sitters_have_a_heading():
    assert headings(people(pose(ARMS_DOWN)), parts_of(people(pose(ARMS_DOWN)))).norm() == 0
    seated = people(pose(SEATED))
    assert headings(seated, parts_of(seated)).norm() == pytest.approx(1)


def test_joints_by_name_and_rings_of_skin_agree():
    for turns in (ARMS_DOWN, SEATED, STRIDE):
        base = pose(turns)
        bare = people(base)
        verts, joints = open_body().posed(base)
        lift = (bare.verts - verts).mean(1, keepdim=True)
        named = replace(bare, joints=joints + lift, joint_names=open_body().joint_names)
        assert posture(bare) == posture(named) == posture(bare, None)


def test_every_chance_is_one():
    bodies = people(pose(SEATED, 3), fps=30.0)
    found = touching(bodies, parts_of(bodies), 0.0)
    assert found.shape == bodies.verts.shape[:2]
    assert ((found >= 0) & (found <= 1)).all()


def test_people_must_be_in_the_world():
    bodies = replace(people(pose(SEATED)), space="camera")
    with pytest.raises(ValueError, match="'camera', expected 'world'"):
        touching(bodies, parts_of(bodies), 0.0)


def test_who_sits_high_up_with_hanging_feet_sits():
    high = replace(people(pose(SEATED)), joints=None)
    up = torch.tensor([0.0, 1.0, 0.0])
    for lift, sits in ((0.0, True), (0.4, False), (1.0, True)):
        bodies = replace(high, verts=high.verts + lift * up)
        assert posture(bodies) == (["sitting"] if sits else [""])
    assert chance(replace(high, verts=high.verts + up), "seat") > 0.2
