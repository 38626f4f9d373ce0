"""Each reading of the paper in its literal form, against its printed formula or a known room."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import GROUND, make_inputs, moved
from figures import SEATED, people, pose
from test_gather import columns, seen
from trimesh.creation import box

from mover.bodies.parts import members, parts_of
from mover.core.settings import check_settings
from mover.core.types import Bodies, Camera, Layout, People
from mover.energy.config import Readings, SceneWeights, only
from mover.energy.human_terms import FootContacts, bounds_of, shares_of
from mover.geometry.camera import tilted
from mover.geometry.placement import place, rest_on_support
from mover.pipeline.presets import PRESETS, READINGS, literally
from mover.stages.camera.align_camera import AlignInputs, align_camera
from mover.stages.config import AlignConfig, AssignConfig, GatherConfig, PlaceConfig
from mover.stages.contacts.assign_contacts import AssignInputs, contact_rows
from mover.stages.contacts.gather_cues import GatherInputs, depth_bounds
from mover.stages.objects.place_objects import energy_of
from mover.stages.objects.prepare_objects import find_regions
from mover_bench.rooms.render import encode

METHOD = Path(__file__).parents[1] / "docs" / "method.md"
INPUTS = make_inputs(torch.float64, size=48)


def energy(term: str, layout: Layout, inputs=INPUTS, **literal: str):
    config = PlaceConfig(only(**{term: 1.0}), "paper", readings=Readings(**literal))
    return energy_of(inputs, config)(layout)


def off(seed: int = 3, tall: float = 0.0) -> Layout:
    """Objects off the truth, as high as asked, on the floor."""
    layout, objects = moved(INPUTS.starts, seed, 0.15), INPUTS.objects
    layout = replace(layout, log_scale=layout.log_scale + tall)
    return rest_on_support(layout, objects.supports, objects.size[:, 1], GROUND)


def test_printed_is_paper_with_every_reading_literal_and_each_reading_changes_something():
    assert PRESETS["printed"] == literally(PRESETS["paper"], *READINGS)
    for name in READINGS:
        assert literally(PRESETS["paper"], name) != PRESETS["paper"]
    check_settings(PRESETS["printed"], "printed")
    weights: SceneWeights = PRESETS["printed"].place.weights
    assert weights == PRESETS["paper"].place.weights


def test_the_table_of_the_docs_has_each_reading_with_its_setting():
    rows = {m[1]: m[2] for m in re.finditer(r"\| ([a-z ]+): `([\w.]+)` \|", METHOD.read_text())}
    assert rows == {name: list(way)[-1] for name, way in READINGS.items()}


def test_bounds_that_contradict_each_other_cost_twice():
    depth = INPUTS.humans.depth
    crossed = replace(depth, near=depth.near + 0.3)  # 10 cm before and 20 cm behind the surface
    inputs = replace(INPUTS, humans=replace(INPUTS.humans, depth=crossed))
    assert float(energy("depth", INPUTS.starts, inputs).total) == 0
    found = energy("depth", INPUTS.starts, inputs, contradiction="count").per_item[0]
    drawn = (depth.near.isfinite() & (INPUTS.image.masks > 0.5)).sum((-2, -1))
    torch.testing.assert_close(found, 0.2 * drawn * depth.area, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("lookup", ["trilinear", "voxel"])
def test_every_vertex_inside_the_bodies_counts(lookup: str):
    layout = off(tall=0.45)
    volume = INPUTS.humans.space.volume
    found = energy("collision", layout, surface="vertices", lookup=lookup).per_item[0]
    corners = place(INPUTS.objects.verts, layout)[0]
    for i, verts in enumerate(corners.numpy()):
        want = 0.0
        for p in verts:
            at = (p - volume.origin.numpy()) / volume.cell
            value = float(volume.values[tuple(np.round(at).astype(int))])
            if lookup == "trilinear":  # the field changes with the height alone
                low = int(np.floor(at[1]))
                column = volume.values[5, :, 5].numpy()
                value = column[low] + (at[1] - low) * (column[low + 1] - column[low])
            want += min(value, 0.0) ** 2
        assert float(found[i]) == pytest.approx(want, rel=1e-9)
    assert found.sum() > 0


def test_a_voxel_pulls_as_the_field_about_it():
    """A cabinet 10 cm in, whose top is in the voxel whose centre is 15 cm in."""
    layout = INPUTS.starts
    free = torch.zeros_like(layout.log_scale)
    free[0, 2, 1] = np.log(2.3 / 1.8)
    free.requires_grad_()
    found = [
        energy("collision", replace(layout, log_scale=free), lookup=way).total
        for way in ("trilinear", "voxel")
    ]
    assert [float(x.detach()) for x in found] == pytest.approx([10, 22.5], rel=1e-4)
    slopes = [float(torch.autograd.grad(x, free)[0][0, 2, 1]) for x in found]
    assert slopes == pytest.approx([460, 690], rel=1e-4)


def touched(weight: float = 1.0):
    """The analytic room, whose stool has a back 20 cm behind its top, some of it touched."""
    objects, touches = INPUTS.objects, INPUTS.humans.touches
    behind = objects.top + torch.tensor([0.0, 0.3, -0.2])
    has_back = torch.tensor([True, False, False])
    many = touches.weight.clone()
    many[0, 1, :5] = weight
    touches = replace(touches, weight=many, share=shares_of(many))
    humans = replace(INPUTS.humans, touches=touches)
    objects = replace(objects, back=behind.to(objects.top), has_back=has_back)
    return replace(INPUTS, objects=objects, humans=humans)


@pytest.mark.parametrize("contact", ["sum", "components"])
def test_contact_is_a_sum_over_vertices_or_over_their_components(contact: str):
    inputs, layout = touched(2.0), off()
    touches = inputs.humans.touches
    found = energy("contact", layout, inputs, contact=contact).per_item[0]
    tops, backs = (place(p, layout)[0].numpy() for p in (inputs.objects.top, inputs.objects.back))
    for row, i in enumerate(touches.object_of.tolist()):
        want = 0.0
        skin = touches.points[row].flatten(0, 1).numpy()
        for k, (p, weight) in enumerate(zip(skin, touches.weight[row].flatten(), strict=True)):
            top, back = (
                p - part[np.linalg.norm(part - p, axis=1).argmin()] for part in (tops[i], backs[i])
            )
            one = np.linalg.norm(back if k // touches.weight.shape[-1] % 2 else top)
            if contact == "components":
                one = abs(top[1]) + (i == 0) * np.hypot(back[0], back[2])
            want += float(weight) * one
        assert float(found[i]) == pytest.approx(want, abs=1e-4)
    assert found[0] > found[1] > 0


def test_both_regions_of_an_object_bound_it():
    half = seen(columns(4, 10))
    found = bounds_of(half, columns(5, 11)[None], 0, vote=False)
    assert (found.near[:, 5:10] == torch.tensor(2.3)).all()
    assert (found.far[:, 10] == 2.0).all()


@pytest.mark.parametrize(("near", "depth"), [("exit", 2.5), ("far side", 3.5)])
def test_the_near_bound_is_the_first_exit_or_the_far_side_of_the_body(near: str, depth: float):
    """A body of two cubes, 2 to 2.5 m and 3 to 3.5 m before the camera."""
    cubes = [box((0.5, 0.5, 0.5)).apply_translation((0, 0, -z)) for z in (2.25, 3.25)]
    verts = torch.cat([torch.tensor(c.vertices).float() for c in cubes])
    faces = torch.cat([torch.tensor(c.faces) + 8 * k for k, c in enumerate(cubes)])
    K = torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), 80, 60)
    zero = torch.zeros(1, dtype=torch.long)
    bodies = Bodies(verts[None], faces, None, (), zero, zero, None, "world", None)
    whole = np.ones((1, 60, 80), dtype=bool)
    sight = GatherInputs(bodies, People(encode(list(whole)), zero, zero, {}),
                         torch.ones(1, 60, 80, dtype=torch.bool), camera)  # fmt: skip
    found = depth_bounds(sight, GatherConfig(near=near, erode=0), 1)
    assert float(found.near[30, 40]) == pytest.approx(depth, abs=1e-4)
    assert found.near[2, 2] == -torch.inf


def test_regions_by_normals_are_all_that_looks_up_or_forward():
    up, forward = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    points = torch.tensor([[0.0, 0.45, 0.1], [0.3, 0.65, 0.0], [0.0, 0.7, -0.2], [0.0, 0.2, 0.2]])
    normals = torch.stack([up, up, forward, forward])
    for category, backs in (("chair", points[2:]), ("stool", points[:0])):
        top, back = find_regions(points, normals, category, "normals")
        assert torch.equal(top, points[:2])
        assert torch.equal(back, backs)


def test_each_vertex_touches_the_nearest_object_whose_mask_it_projects_into():
    """Of two stools, the left hides nothing of the right half of a sitter."""
    bodies = people(pose(SEATED))
    parts = parts_of(bodies)
    seat = members(parts, "seat", "left_thigh", "right_thigh")
    middle = bodies.verts[0, seat].mean(0)
    camera = replace(make_inputs().camera, R_cam_world=tilted(*torch.zeros(2)))
    bodies = replace(bodies, verts=bodies.verts - middle + torch.tensor([0.0, 0.0, -3.0]))
    objects = replace(make_inputs().objects, has_top=torch.tensor([True, True, True]))
    at = torch.tensor([[-0.1, -0.45, -3.0], [0.1, -0.7, -3.0], [0.0, -1.8, -9.0]])
    layout = Layout(at, torch.zeros(3), torch.zeros(3, 3))
    masks = torch.zeros(3, 360, 640, dtype=torch.bool)
    masks[0, :, :320], masks[1, :, 320:], masks[2] = True, True, True
    chance = seat.float()[None]
    inputs = AssignInputs(bodies, chance, parts, masks, torch.zeros(3, 4), camera, objects, layout)
    (rows,) = contact_rows(inputs, AssignConfig("vertex"))
    assert rows.vert.tolist() == seat.nonzero()[:, 0].tolist()
    left = bodies.verts[0, rows.vert, 0] < 0
    assert bool(left.any())
    assert bool((~left).any())
    assert torch.equal(rows.object_of, (~left).long())
    assert not rows.hand.any()


def test_all_feet_together_bound_the_floor_alone():
    """Their mean is on the floor; the tilt, which one point cannot give, hardly moves."""
    first = torch.tensor(0.05), torch.tensor(-0.02)
    R = tilted(*first)
    world = torch.tensor([[-1.0, -1.5, -2.0], [1.0, -1.3, -3.0], [0.5, -1.4, -4.0]])
    zero = torch.arange(3)
    feet = FootContacts(world @ R.mT, 0 * zero, zero, ())
    camera = replace(make_inputs().camera, R_cam_world=R)
    config = AlignConfig((0.1,), float("inf"), 0.0, "sum")
    found = align_camera(AlignInputs(feet, camera, -1.4, None), config)
    assert found.ground == pytest.approx(-1.4, abs=1e-4)
    torch.testing.assert_close(found.camera.R_cam_world, R, atol=1e-4, rtol=0)
    assert "all feet count as one point" in found.warnings[0]
