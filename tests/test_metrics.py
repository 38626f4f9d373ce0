"""Metrics of objects, camera, contact, floor and pose: analytic cases and other libraries."""

import math
from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from judged import (
    CAMERA,
    F64,
    GROUND,
    K,
    cuboid,
    grid_body,
    mesh_of,
    moved,
    pair,
    people,
    piece,
    random_piece,
    room,
    some_people,
)
from scipy.spatial.transform import Rotation

from mover.core.types import Camera, Mesh
from mover.evaluate import bodies as errors
from mover.evaluate import scene as metrics
from mover.evaluate.scene import measure
from mover.geometry.camera import project, tilted, to_camera
from mover.geometry.nearest import to_surface
from mover.geometry.placement import place_object
from mover.geometry.rotations import rot_y

NUMBERS = st.lists(st.floats(-1, 1), min_size=10, max_size=10)


@given(NUMBERS, NUMBERS)
@settings(max_examples=60, deadline=None)
def test_overlap_of_turned_boxes_is_that_of_a_solid_modeller(a, b):
    solids = []
    for item in (random_piece(a), random_piece(b)):
        mesh = place_object(item)
        verts = mesh.verts.numpy()
        solids.append(
            manifold3d.Manifold(manifold3d.Mesh64(verts, mesh.faces.numpy().astype(np.uint64)))
        )
    shared, joint = (solids[0] ^ solids[1]).volume(), (solids[0] + solids[1]).volume()
    assert metrics.iou3d(pair(random_piece(a), random_piece(b))) == pytest.approx(
        shared / joint, abs=1e-6
    )


@given(NUMBERS, NUMBERS)
@settings(max_examples=25, deadline=None)
def test_swapping_estimate_and_truth_changes_no_symmetric_metric(a, b):
    first, second = random_piece(a), random_piece(b)
    for metric in (metrics.iou3d, metrics.iou2d, metrics.center_error):
        there, back = metric(pair(first, second)), metric(pair(second, first))
        assert there == pytest.approx(back, abs=1e-9), metric.__name__
        assert math.isfinite(there)


def test_a_flat_object_at_its_place_overlaps_itself() -> None:
    rug = room().objects[2]
    assert metrics.iou3d(pair(rug, rug)) == pytest.approx(1)
    assert metrics.iou3d(pair(moved(rug, 0.5, 0, 0), rug)) < 0.6


def test_surface_distance_of_a_shifted_sphere_is_the_integral() -> None:
    sphere = piece(mesh_of(trimesh.creation.icosphere(4, 1.0)), (0, 0, -4))
    cosine = np.linspace(-1, 1, 20001)
    for shift in (0.1, 0.3, 0.8):
        exact = np.abs(np.sqrt(1 + shift**2 - 2 * shift * cosine) - 1).mean()
        found = metrics.p2s(pair(moved(sphere, shift, 0, 0), sphere))
        assert found == pytest.approx(exact, rel=0.02)


def test_surface_distance_is_measured_to_triangles_and_in_one_direction() -> None:
    plate, cube = piece(cuboid(2, 0.0001, 2), (0, 0, -3)), piece(cuboid(2, 2, 2), (0, 0, -3))
    assert metrics.p2s(pair(cube, plate)) < 1e-3
    sides, top = 4 * 1.0, 2.0  # mean height of a side wall is 1, the lid is 2 above the plate
    assert metrics.p2s(pair(plate, cube)) == pytest.approx((sides + top) / 6, rel=0.02)


def test_samples_of_a_surface_weigh_it_by_its_area() -> None:
    shape = trimesh.creation.box((1.0, 0.02, 0.6)) + trimesh.creation.icosphere(2, 0.3)
    shape.apply_translation([0.2, 0.1, -0.4])
    points = metrics.area_samples(mesh_of(shape), 10_000).numpy()
    assert np.allclose(points.mean(0), shape.centroid, atol=2e-3)
    many = trimesh.sample.sample_surface(shape, 400_000, seed=0)[0]
    assert np.allclose(np.cov(points.T), np.cov(many.T), atol=2e-3)
    mesh = mesh_of(shape)
    assert to_surface(torch.tensor(points[::50]), mesh.verts, mesh.faces).max() < 1e-9
    upper = (points[:, 1] > 0.1099) & (points[:, 1] < 0.1101)
    lower = (points[:, 1] > 0.0899) & (points[:, 1] < 0.0901)
    assert upper.mean() == pytest.approx(0.6 / shape.area, abs=5e-3)
    assert lower.mean() == pytest.approx(0.6 / shape.area, abs=5e-3)


def test_centre_and_overlap_do_not_depend_on_the_origin_of_the_mesh() -> None:
    truth = piece(cuboid(0.5, 0.9, 0.6), (0.3, GROUND, -2), 0.7)
    offset = torch.tensor([0.4, -0.2, 1.0], dtype=F64)
    other = replace(
        truth, mesh=Mesh(truth.mesh.verts + offset, truth.mesh.faces),
        t_world_object=truth.t_world_object - rot_y(truth.yaw) @ offset,
    )  # fmt: skip
    assert metrics.center_error(pair(other, truth)) == pytest.approx(0, abs=1e-12)
    assert metrics.iou3d(pair(other, truth)) == pytest.approx(1)


def test_camera_errors_are_differences_of_pitch_and_roll() -> None:
    turned = tilted(torch.tensor(-0.25, dtype=F64), torch.tensor(-0.07, dtype=F64))
    scene = room()
    sight = metrics.Sight(replace(scene, camera=replace(CAMERA, R_cam_world=turned)), scene)
    assert metrics.pitch_error(sight) == pytest.approx(0.05)
    assert metrics.roll_error(sight) == pytest.approx(0.09)


def test_the_image_box_holds_the_drawn_mesh_and_is_cut_at_the_border() -> None:
    item = piece(cuboid(0.5, 0.9, 0.5), (-0.6, GROUND, -2.5), 0.4)
    pixels = project(to_camera(place_object(item).verts, CAMERA.R_cam_world), K)
    expected = torch.cat([pixels.amin(0), pixels.amax(0)]) / torch.tensor([640, 480, 640, 480])
    found = metrics.image_box(item, CAMERA)
    assert torch.allclose(found, expected)
    found = metrics.image_box(moved(item, -1, 0, 0), CAMERA)
    assert found[0] == 0
    assert metrics.image_box(moved(item, -9, 0, 0), CAMERA) is None
    assert metrics.image_box(moved(item, 0, 0, 9), CAMERA) is None


def test_a_mesh_that_passes_the_camera_is_cut_before_it() -> None:
    level = Camera(K, tilted(torch.zeros((), dtype=F64), torch.zeros((), dtype=F64)), 640, 480)
    beam = piece(cuboid(0.02, 0.02, 4), (0.05, 0.0, 0.0))
    along = torch.linspace(-2, 2, 40001, dtype=F64)
    verts = torch.cat([
        torch.stack([torch.full_like(along, x), torch.full_like(along, y), along], -1)
        for x in (0.04, 0.06) for y in (0, 0.02)
    ])  # fmt: skip
    in_cam = to_camera(verts, level.R_cam_world)
    pixels = project(in_cam[in_cam[:, 2] >= 0.05], K) / torch.tensor([640, 480])
    expected = torch.cat([pixels.amin(0), pixels.amax(0)]).clamp(0, 1)
    found = metrics.image_box(beam, level)
    assert torch.allclose(found, expected, atol=2e-3)


def test_an_object_off_the_image_scores_zero_and_a_true_one_cannot_be_scored() -> None:
    here = piece(cuboid(0.5, 0.9, 0.5), (0, GROUND, -2.5))
    gone = moved(here, -9, 0, 0)
    assert metrics.iou2d(pair(gone, here)) == 0
    assert metrics.iou2d(pair(here, gone)) is None


def test_names_decide_before_places() -> None:
    scene = room()
    swapped = tuple(
        replace(p, id=name)
        for p, name in zip(scene.objects, ("table", "chair", "rug"), strict=True)
    )
    names = {p.id: p.id for p in scene.objects}
    found = metrics.match(replace(scene, objects=swapped), scene, names)
    assert {k: p.id for k, p in found.items()} == names


def test_without_names_the_best_overlaps_within_a_class_decide() -> None:
    truth = room()
    row = [piece(cuboid(0.5, 0.9, 0.5), (x, GROUND, -3), 0, f"c{x}") for x in (-0.6, 0.0, 0.6)]
    shifted = [replace(moved(p, 0.2, 0, 0), id=f"z{i}") for i, p in enumerate(row)]
    sofa = replace(moved(row[1], 0, 0, 0), id="couch", category="Couch")
    true_sofa = replace(moved(row[1], 5, 0, 0), id="s", category="sofa")
    found = metrics.match(
        replace(truth, objects=(*shifted[::-1], sofa)),
        replace(truth, objects=(*row, true_sofa)),
        {"c0.6": "nobody"},
    )
    assert {k: p.id for k, p in found.items()} == {
        "c-0.6": "z0", "c0.0": "z1", "c0.6": "z2", "s": "couch",
    }  # fmt: skip


def test_of_two_that_stand_for_one_the_nearer_is_taken() -> None:
    truth = replace(room(), objects=room().objects[:1])
    far, near = (replace(moved(truth.objects[0], x, 0, 0), id=f"at{x}") for x in (-30, 20))
    found = metrics.match(replace(truth, objects=(far, near)), truth, {})
    assert found["chair"].id == "at20"


BOX = [errors.StandingMesh(cuboid(1, 1, 1))]  # its top is at 1
INSIDE, ABOVE = (0.92, 1.32), (1.04, 1.44)  # five rows, of which one is inside; none is


@pytest.mark.parametrize(("bodies", "free", "share", "rows"), [
    ([INSIDE], 4 / 5, 1, None), ([ABOVE], 1, 0, 5), ([INSIDE, ABOVE], 0.9, 0.5, None),
])  # fmt: skip
def test_collision_and_contact_are_shares_of_vertices_and_means_over_bodies(
    bodies, free, share, rows
):
    people = some_people(torch.cat([grid_body(*heights) for heights in bodies]))
    touch = errors.gather_touch(people, BOX, None, 10, 0.05)
    assert errors.non_collision(touch) == pytest.approx(free)
    assert errors.contact(touch) == pytest.approx(share)
    assert errors.contact_f1(touch) is None
    assert bodies != [ABOVE] or int((touch.near.surface <= 0.05).sum()) == rows


def test_contact_f1_compares_the_touching_vertices_with_the_true_ones():
    true = some_people(grid_body(1.0, 1.4, 9))  # heights 1, 1.05, 1.1, ...: two rows touch
    high = some_people(grid_body(1.04, 1.44, 9))  # one row touches
    for judged, expected in ((true, 1.0), (high, 2 * 9 / (9 + 18))):
        truth = errors.gather_truth(true, BOX, judged, 10, 0.0501)
        touch = errors.gather_touch(judged, BOX, truth, 10, 0.0501)
        assert errors.contact_f1(touch) == pytest.approx(expected)
    none = errors.Nearness(torch.full((1, 3), torch.inf), torch.full((1, 3), torch.inf))
    assert errors.contact_f1(errors.Touch(none, none, none, 0.05)) == 1


def test_contact_f1_is_paired_by_frame_and_person_not_by_row():
    bodies = some_people(torch.cat([grid_body(1.0, 1.4), grid_body(1.04, 1.44), grid_body(2, 3)]))
    order = torch.tensor([2, 0, 1])
    shuffled = replace(bodies, verts=bodies.verts[order], frame=bodies.frame[order])
    truth = errors.gather_truth(shuffled, BOX, bodies, 10, 0.05)
    assert errors.contact_f1(errors.gather_touch(bodies, BOX, truth, 10, 0.05)) == 1
    later = replace(bodies, frame=bodies.frame + 1)  # frames 1, 2, 3: of the true 0, 1, 2
    touch = errors.gather_touch(later, BOX, truth, 10, 0.05)
    assert touch.shared.signed.shape[0] == 2
    assert touch.near.signed.shape[0] == 3


def test_distances_within_reach_are_those_to_all_objects_without_culling():
    rng = torch.Generator().manual_seed(0)
    verts = torch.rand(3, 400, 3, generator=rng, dtype=F64) * 3 - 1.5
    sphere = mesh_of(trimesh.creation.icosphere(3, 0.8))
    frame = torch.arange(3)
    solid = [errors.StandingMesh(sphere), *BOX]
    found = errors.nearness(verts, frame, solid, 0.05)
    whole = errors.nearness(verts, frame, solid, 10.0)
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
    picked = errors.evenly(rows, count).tolist()
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
