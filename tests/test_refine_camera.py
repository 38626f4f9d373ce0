import functools
from dataclasses import replace

import torch
from analytic import GROUND, make_inputs

from mover.energy.config import Adam
from mover.energy.objective import HumanCues
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.placement import reproject, rest_on_support
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
    found = RefineInputs(
        camera, ground, Gaussian(feet, torch.linalg.inv(LOOSE)), objects, inputs.image,
        fitted.layout,
    )  # fmt: skip
    return inputs.camera, found


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
