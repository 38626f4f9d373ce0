"""Postures, and which skin touches: by posture, motion and normals."""

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
FORWARD = {**LEANING, **{f"{s}_hip": (-1.9, 0, 0) for s in ("left", "right")}}
LIFTED = {**ARMS_DOWN, "left_hip": (-0.9, 0, 0), "left_knee": (0.9, 0, 0)}
PALM_UP = {**AT_TABLE, "left_shoulder": (1.57, 0.0, -1.2), "left_elbow": (0.0, -1.5, 0.0)}
ON_LAP = {**SEATED, "left_shoulder": (0.0, -0.5, -1.25), "left_elbow": (0.0, -0.9, 0.0)}
SOLES, THIGHS = ("left_sole", "right_sole"), ("left_thigh", "right_thigh")


def video(turns, count):
    return people(pose(turns, count), fps=30.0)


def chance(bodies, *names: str, ground: float = 0.0):
    """Share of a part that touches, for each body."""
    parts = parts_of(bodies)
    return touching(bodies, parts, ground)[:, members(parts, *names)].mean(1)


def posture(bodies, ground: float | None = 0.0) -> set[str]:
    found = postures(bodies, parts_of(bodies), ground)
    kinds = {"standing": found.standing, "sitting": found.sitting, "lying": found.lying}
    return {"/".join(k for k, v in kinds.items() if v[i]) for i in range(len(bodies.verts))}


STANDING, SITTING, STILL = people(pose(ARMS_DOWN)), people(pose(SEATED)), video(ARMS_DOWN, 4)
FALLING, TABLE = moving(video(SEATED, 5), 0.0, -0.02, 0.0), video(AT_TABLE, 3)
SUPINE, PRONE = (
    people(turned(pose(ARMS_DOWN), pitch, 0.0, 0.0), floor=0.5) for pitch in (-1.57, 1.57)
)
BACK = people(turned(pose(LEANING), -0.35, 0.0, 0.0))
BENT = people(turned(pose(FORWARD), 0.3, 0.0, 0.0))
CASES = {
    "standing feet touch": (STANDING, {SOLES: (0.95, 1)}, "standing"),
    "a lifted foot does not": (
        people(pose(LIFTED)), {SOLES[:1]: (0, 0), SOLES[1:]: (0.95, 1)}, None),
    "a sitter touches with thighs that face down": (
        SITTING, {THIGHS: (0.6, 1), ("back",): (0, 0)}, "sitting"),
    "a walker touches with soles only": (
        moving(video(STRIDE, 6), 0.0, 0.0, 0.04), {("seat", "back", *THIGHS): (0, 0)}, "standing"),
    "a sole at rest touches": (STILL, {SOLES[:1]: (0.95, 1)}, "standing"),
    "a sole that slides does not": (moving(STILL, 0.0, 0.0, 0.03), {SOLES[:1]: (0, 0)}, None),
    "sitting down is not yet sitting": (FALLING, {}, ""),
    "but in one image it looks so": (replace(FALLING, fps=None), {}, "sitting"),
    "a back that leans back touches": (BACK, {("back",): (0.6, 1)}, "sitting"),
    "one that leans forward does not": (BENT, {("back",): (0, 0)}, "sitting"),
    "who is supine touches with the back": (SUPINE, {("back",): (0.7, 1)}, "lying"),
    "who is prone does not": (PRONE, {("back", "seat"): (0, 0)}, "lying"),
    "a palm that faces up does not touch": (
        video(PALM_UP, 3), {("left_palm",): (0, 0.05)}, None),
    "nor one that waves": (moving(TABLE, 0.0, 0.0, 0.02), {("right_palm",): (0, 0)}, None),
    "nor raised ones": (people(pose(ARMS_UP)), {("left_palm", "right_palm"): (0, 0)}, None),
    "nor one on the own lap": (people(pose(ON_LAP)), {("left_palm",): (0, 0)}, "sitting"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_postures_and_what_touches(name):
    bodies, shares, kind = CASES[name]
    for parts, (low, high) in shares.items():
        found = chance(bodies, *parts)
        assert low <= found.min()
        assert found.max() <= high
    assert kind is None or posture(bodies) == {kind}


def test_touching_skin_is_where_it_can_be():
    def touched(bodies):
        return touching(bodies, parts_of(bodies), 0.0)[0]

    parts, found = parts_of(SITTING), touched(SITTING)
    assert touched(STANDING)[~members(parts, *SOLES)].max() == 0
    sure, height = (found > 0.5) & members(parts, "seat", *THIGHS), SITTING.verts[0, :, 1]
    assert sure.sum() > 100
    assert height[sure].max() - height[sure].min() < 0.15
    assert height[sure].min() < height[members(parts, "seat")].min() + 0.01
    prone = touched(PRONE) > 0.5
    assert prone.sum() > 100
    assert PRONE.verts[0, prone, 1].max() < 0.6
    palm = touching(TABLE, parts, 0.0)[:, members(parts, "right_palm")]
    assert palm.amax(1).min() > 0.5  # what reaches lowest touches a flat surface
    lap = people(pose(ON_LAP)).verts[0]
    places = [lap[members(parts, part)].mean(0) for part in ("left_palm", "left_thigh")]
    assert (places[0] - places[1]).norm() < 0.25
    assert postures(BACK, parts_of(BACK), 0.0).recline == pytest.approx(0.35, abs=0.06)


def test_speed_is_taken_within_a_track_and_over_real_time():
    alone = video(SEATED, 4)
    far = alone.verts + torch.tensor([[[0.0, 0, 0]], [[1, 0, 0]]]).repeat_interleave(2, 0)
    two = replace(alone, verts=far, person=torch.tensor([0, 0, 1, 1]))
    one = replace(two, person=torch.zeros(4).long())
    assert posture(two) == {"sitting"}
    assert posture(one) == {""}
    assert posture(replace(one, frame=torch.arange(4) * 90)) == {"sitting"}
    shuffled = torch.tensor([2, 0, 3, 1])
    mixed = moving(alone, 0.0, 0.0, 0.05)
    mixed = replace(mixed, verts=mixed.verts[shuffled], frame=mixed.frame[shuffled])
    assert posture(mixed) == {""}


def test_trembling_by_a_centimetre_is_still_sitting():
    still = video(SEATED, 12)
    shake = 0.006 * torch.randn(12, 1, 3, generator=torch.Generator().manual_seed(0))
    assert posture(replace(still, verts=still.verts + shake)) == {"sitting"}


@settings(max_examples=8, deadline=None)
@given(yaw=st.floats(-3.1, 3.1), x=st.floats(-3, 3), z=st.floats(-5, -1))
def test_touch_ignores_position_and_heading_and_headings_follow(yaw, x, z):
    R = rot_y(torch.tensor(yaw))
    moved = replace(SITTING, verts=SITTING.verts @ R.T + torch.tensor([x, 0.0, z]))
    parts = parts_of(SITTING)
    found, usual = (touching(bodies, parts, 0.0) for bodies in (moved, SITTING))
    torch.testing.assert_close(found, usual, atol=1e-3, rtol=0)
    ahead = R @ torch.tensor([0.0, 0, 1])
    torch.testing.assert_close(headings(moved, parts)[0], ahead, atol=0.03, rtol=0)


def test_only_sitters_have_a_heading():
    assert headings(STANDING, parts_of(STANDING)).norm() == 0
    assert headings(SITTING, parts_of(SITTING)).norm() == pytest.approx(1)


def test_joints_by_name_and_rings_of_skin_agree():
    for turns in (ARMS_DOWN, SEATED, STRIDE):
        base = pose(turns)
        bare = people(base)
        verts, joints = open_body().posed(base)
        lift = (bare.verts - verts).mean(1, keepdim=True)
        named = replace(bare, joints=joints + lift, joint_names=open_body().joint_names)
        assert posture(bare) == posture(named) == posture(bare, None)


def test_chances_are_chances_and_people_must_be_in_the_world():
    bodies = video(SEATED, 3)
    found = touching(bodies, parts_of(bodies), 0.0)
    assert found.shape == bodies.verts.shape[:2]
    assert ((found >= 0) & (found <= 1)).all()
    with pytest.raises(ValueError, match="'camera', expected 'world'"):
        touching(replace(SITTING, space="camera"), parts_of(SITTING), 0.0)


def test_a_person_seated_high_up_with_hanging_feet_sits():
    high, up = replace(SITTING, joints=None), torch.tensor([0.0, 1.0, 0.0])
    for lift, kind in ((0.0, "sitting"), (0.4, ""), (1.0, "sitting")):
        assert posture(replace(high, verts=high.verts + lift * up)) == {kind}
    assert chance(replace(high, verts=high.verts + up), "seat") > 0.2
