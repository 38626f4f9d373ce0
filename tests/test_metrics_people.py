"""Metrics of contact, floor and pose: analytic bodies, another library."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from judged import F64, cuboid, grid_body, mesh_of, people, some_people
from scipy.spatial.transform import Rotation

from mover.evaluate import bodies as errors
from mover.evaluate import contact as contacts
from mover.evaluate.scene import measure

BOX = [contacts.StandingMesh(cuboid(1, 1, 1))]  # its top is at 1
INSIDE, ABOVE = (0.92, 1.32), (1.04, 1.44)  # five rows, of which one is inside; none is


@pytest.mark.parametrize(("bodies", "free", "share", "rows"), [
    ([INSIDE], 4 / 5, 1, None), ([ABOVE], 1, 0, 5), ([INSIDE, ABOVE], 0.9, 0.5, None),
])  # fmt: skip
def test_collision_and_contact_are_shares_of_vertices_and_means_over_bodies(
    bodies, free, share, rows
):
    people = some_people(torch.cat([grid_body(*heights) for heights in bodies]))
    touch = contacts.gather_touch(people, BOX, None, 10, 0.05)
    assert contacts.non_collision(touch) == pytest.approx(free)
    assert contacts.contact(touch) == pytest.approx(share)
    assert contacts.contact_f1(touch) is None
    assert bodies != [ABOVE] or int((touch.near.surface <= 0.05).sum()) == rows


def test_contact_f1_compares_the_touching_vertices_with_the_true_ones():
    true = some_people(grid_body(1.0, 1.4, 9))  # heights 1, 1.05, 1.1, ...: two rows touch
    high = some_people(grid_body(1.04, 1.44, 9))  # one row touches
    for judged, expected in ((true, 1.0), (high, 2 * 9 / (9 + 18))):
        truth = contacts.gather_truth(true, BOX, judged, 10, 0.0501)
        touch = contacts.gather_touch(judged, BOX, truth, 10, 0.0501)
        assert contacts.contact_f1(touch) == pytest.approx(expected)
    none = contacts.Nearness(torch.full((1, 3), torch.inf), torch.full((1, 3), torch.inf))
    assert contacts.contact_f1(contacts.Touch(none, none, none, 0.05)) == 1


def test_contact_f1_is_paired_by_frame_and_person_not_by_row():
    bodies = some_people(torch.cat([grid_body(1.0, 1.4), grid_body(1.04, 1.44), grid_body(2, 3)]))
    order = torch.tensor([2, 0, 1])
    shuffled = replace(bodies, verts=bodies.verts[order], frame=bodies.frame[order])
    truth = contacts.gather_truth(shuffled, BOX, bodies, 10, 0.05)
    assert contacts.contact_f1(contacts.gather_touch(bodies, BOX, truth, 10, 0.05)) == 1
    later = replace(bodies, frame=bodies.frame + 1)  # frames 1, 2, 3: of the true 0, 1, 2
    touch = contacts.gather_touch(later, BOX, truth, 10, 0.05)
    assert touch.shared.signed.shape[0] == 2
    assert touch.near.signed.shape[0] == 3


def test_distances_within_reach_are_those_to_all_objects_without_culling():
    rng = torch.Generator().manual_seed(0)
    verts = torch.rand(3, 400, 3, generator=rng, dtype=F64) * 3 - 1.5
    sphere = mesh_of(trimesh.creation.icosphere(3, 0.8))
    frame = torch.arange(3)
    solid = [contacts.StandingMesh(sphere), *BOX]
    found = contacts.nearness(verts, frame, solid, 0.05)
    whole = contacts.nearness(verts, frame, solid, 10.0)
    near = whole.surface <= 0.05
    assert near.sum() > 50
    assert torch.equal(near, found.surface <= 0.05)
    assert torch.equal(whole.signed < 0, found.signed < 0)
    assert torch.allclose(found.signed[whole.signed < 0], whole.signed[whole.signed < 0])
    in_box = ((verts - torch.tensor([0, 0.5, 0])).abs() < 0.5).all(-1)
    in_ball = verts.norm(dim=-1) < 0.8
    assert ((whole.signed < 0) != (in_box | in_ball)).sum() <= 8  # the ball has flat triangles


@given(st.integers(1, 500), st.integers(2, 100))
def test_rows_are_thinned_evenly_and_each_at_most_once(rows, count):
    picked = contacts.evenly(rows, count).tolist()
    assert len(set(picked)) == len(picked) == min(rows, count)
    assert picked[0] == 0
    assert picked[-1] == rows - 1
    steps = np.diff(picked)
    assert len(steps) == 0 or steps.max() - steps.min() <= 1


def test_soles_under_the_floor_are_counted_and_measured():
    under = torch.tensor([[0.1, 0.0, -0.005, -0.02], [0.3, -0.04, 0, 0]])
    for heights, share, depth in ((under, 2 / 8, 0.03), (torch.ones(2, 3), 0, 0)):
        standing = errors.Standing(heights, 0.01)
        assert errors.ground_penetration_frequency(standing) == pytest.approx(share)
        assert errors.ground_penetration_distance(standing) == pytest.approx(depth)


@pytest.mark.parametrize("kind", ["unrelated", "similar", "mirrored"])
def test_procrustes_finds_the_rotation_of_another_library_and_the_best_scale(kind):
    rng = np.random.default_rng(2)
    points, target = rng.normal(size=(2, 12, 3))
    if kind != "unrelated":
        turned = 2.5 * points @ Rotation.random(rng=rng).as_matrix().T + [0.3, -1.0, 2.0]
        target = turned if kind == "similar" else turned * [-1.0, 1.0, 1.0]
    a, b = points - points.mean(0), target - target.mean(0)
    turn = Rotation.align_vectors(b, a)[0].as_matrix()
    scale = (b * (a @ turn.T)).sum() / (a**2).sum()
    found = errors.procrustes(torch.tensor(points), torch.tensor(target)).numpy()
    assert np.allclose(found, scale * a @ turn.T + target.mean(0))
    assert np.allclose(found, target) == (kind == "similar")


def test_pose_errors_are_in_the_world_and_aligned_ones_are_not():
    bodies = people(3)
    shift = torch.tensor([0.03, 0.0, 0.04])
    wrong = replace(bodies, verts=bodies.verts + shift, joints=bodies.joints + shift)
    found = errors.gather_twins(wrong, bodies)
    pje, v2v, p_pje, p_v2v = measure(errors.POSE_METRICS, found).values()
    assert (pje, v2v) == pytest.approx((0.05, 0.05), rel=1e-4)
    assert (p_pje, p_v2v) == pytest.approx((0, 0), abs=1e-5)
    assert [joints.shape for joints in found.joints] == [(3, 22, 3)] * 2


def test_joints_are_paired_by_name():
    bodies = people(2)
    order = torch.randperm(55, generator=torch.Generator().manual_seed(0))
    names = tuple(bodies.joint_names[i] for i in order)
    shuffled = replace(bodies, joints=bodies.joints[:, order], joint_names=names)
    assert measure(errors.POSE_METRICS, errors.gather_twins(shuffled, bodies))["pje"] == 0


def test_points_that_coincide_have_an_aligned_error_and_no_nan():
    same, spread = torch.zeros(1, 4, 3), torch.eye(4)[None, :, :3]
    value = measure(errors.POSE_METRICS, errors.Twins((same, spread), None))["p_v2v"]
    assert value == pytest.approx(float((spread - spread.mean(-2)).norm(dim=-1).mean()))
