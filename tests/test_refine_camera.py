import functools
from dataclasses import replace

import pytest
import torch
from analytic import GROUND, boxes_of, image_at, make_inputs

from mover.core.types import Layout
from mover.energy.config import Adam
from mover.energy.objective import HumanCues
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.placement import hit_floor, reproject, rest_on_support
from mover.pipeline.presets import ROBUST
from mover.stages.camera.refine_camera import RefineInputs, refine_camera
from mover.stages.config import RefineConfig
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.place_objects import place_objects
from mover.stages.posterior import Gaussian

LOOSE = torch.diag(torch.tensor([0.07, 0.07, 0.1]).square())
TIGHT = torch.diag(torch.tensor([1e-4, 1e-4, 1e-4]).square())


@functools.cache
def wrong_camera():
    """The analytic room seen through a camera that is 1.5 degrees and 3 cm off, and the true one.

    As in the pipeline objects are placed first, under the wrong camera.
    """
    inputs = make_inputs(size=32)
    pitch, roll = pitch_roll(inputs.camera.R_cam_world)
    wrong = tilted(pitch + 0.026, roll - 0.02)
    objects, ground = inputs.objects, GROUND + 0.03
    start = reproject(inputs.starts, objects.size[:, 1], inputs.camera.R_cam_world, wrong)
    start = rest_on_support(start, objects.supports, objects.size[:, 1], ground)
    camera = replace(inputs.camera, R_cam_world=wrong)
    fitted = place_objects(
        PlaceInputs(objects, camera, ground, inputs.image, HumanCues(), start, start.yaw[0]),
        replace(ROBUST.layout, yaws=1, short=Adam(0)),
    )
    feet = torch.stack([*pitch_roll(camera.R_cam_world), torch.tensor(ground)])
    prior = Gaussian(feet, torch.linalg.inv(LOOSE))
    return inputs.camera, RefineInputs(camera, ground, prior, objects, inputs.image, fitted.layout)


def errors(camera, truth):
    a, b = pitch_roll(camera.R_cam_world), pitch_roll(truth.R_cam_world)
    return [abs(float(x - y)) for x, y in zip(a, b, strict=True)]


def test_exact_objects_find_the_camera_that_the_feet_missed():
    truth, inputs = wrong_camera()
    found = refine_camera(inputs, RefineConfig(rounds=1))
    before, after = errors(inputs.camera, truth), errors(found.camera, truth)
    assert after[0] < 0.3 * before[0]
    assert after[1] < 0.3 * before[1]


def test_feet_that_are_certain_are_trusted():
    _, inputs = wrong_camera()
    inputs = replace(inputs, feet=replace(inputs.feet, precision=torch.linalg.inv(TIGHT)))
    found = refine_camera(inputs, RefineConfig(rounds=1))
    assert max(errors(found.camera, inputs.camera)) < 1e-3
    assert abs(found.ground - inputs.ground) < 1e-3


def test_without_any_object_on_the_floor_nothing_changes():
    _, inputs = wrong_camera()
    free = replace(inputs.objects, supports=torch.full((3,), -2))
    found = refine_camera(replace(inputs, objects=free), RefineConfig(rounds=1))
    assert found.ground == inputs.ground
    assert errors(found.camera, inputs.camera) == [0.0, 0.0]


@pytest.mark.slow
def test_standard_heights_level_a_camera_under_which_all_else_fits():
    """Tables as they look in the image, under a camera that is 1.5 degrees off: sizes fit it."""
    truth, floor = make_inputs(size=32).camera, torch.tensor(GROUND)
    pitch, roll = pitch_roll(truth.R_cam_world)
    wrong = replace(truth, R_cam_world=tilted(pitch + 0.026, roll))
    x, z = torch.tensor([[-0.6, 0.7, -0.9, 1.2], [-2.6, -3.5, -5.0, -6.5]])
    places = torch.stack([x, floor.expand(4), z], -1)
    exact = Layout(places, torch.tensor([0.2, -0.3, 0.1, 0.5]), torch.zeros(4, 3))
    image = image_at(boxes_of(("table",) * 4, [(1.2, 0.74, 0.7)] * 4), exact, truth, 32)
    base = to_camera(places, truth.R_cam_world)
    moved = replace(exact, t_world_object=hit_floor(base / base[:, 2:], wrong.R_cam_world, floor))
    grown = (moved.t_world_object.norm(dim=-1) / places.norm(dim=-1)).tolist()
    assert max(grown) > 1.05 * min(grown)
    feet = Gaussian(torch.stack([pitch + 0.026, roll, floor]), torch.linalg.inv(LOOSE))
    away = []
    for kind in ("table", "box"):  # of boxes no standard is known
        objects = boxes_of((kind,) * 4, [(1.2 * g, 0.74 * g, 0.7 * g) for g in grown])
        inputs = RefineInputs(wrong, GROUND, feet, objects, image, moved)
        away += errors(refine_camera(inputs, RefineConfig(rounds=1)).camera, truth)[:1]
    assert away[0] < 0.7 * away[1] < 0.4 * errors(wrong, truth)[0]
