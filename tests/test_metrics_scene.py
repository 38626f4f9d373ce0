"""Metrics of objects and camera: analytic cases, another library, matching."""

import math
from dataclasses import replace

import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from judged import CAMERA, F64, GROUND, K, cuboid, mesh_of, moved, pair, piece, random_piece, room

from mover.core.types import Camera, Mesh
from mover.evaluate import scene as metrics
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
