"""Where a fit begins with lying people: which way the head is, and what they are rolled to."""

import dataclasses
import math

import pytest
import torch
from make_keypoints import CAMERA, as_bodies, seen, walker

from mover.bodies.skinning import open_body
from mover.core.types import Bodies
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import STAGES, FitConfig
from mover.fitting.ground import trunk_of
from mover.fitting.start import turned_round
from mover.geometry.rotations import rot_x, rot_y, rot_z, rotation_vectors

UP = torch.tensor([0.0, -1.0, 0.0])
STARTED = FitConfig(stages=(dataclasses.replace(STAGES[1], steps=10),))
"""Little more than the hypotheses, which decide."""


def sleeper(rolls: torch.Tensor, head: float) -> Bodies:
    """A person lying 4 m away, 0.9 m below the camera, rolled from the back as far [rad]."""
    pose, frame = walker(len(rolls))
    back = rot_y(torch.tensor(head)) @ rot_z(rolls) @ rot_x(torch.tensor(-0.5 * math.pi))
    place = torch.tensor([0.3, -0.9, -4.0]) @ CAMERA.R_cam_world.mT
    lying = dataclasses.replace(
        pose,
        global_orient=rotation_vectors(CAMERA.R_cam_world @ back),
        body_pose=pose.body_pose[:1].expand(len(rolls), -1).clone(),
        transl=place.expand(len(rolls), 3).clone(),
    )
    return as_bodies(lying, frame)


@pytest.mark.slow
@pytest.mark.parametrize("head", [0.2, 3.0])
@pytest.mark.parametrize("roll", [0.0, 0.5 * math.pi, -0.5 * math.pi, math.pi])
def test_a_person_lying_along_the_view_has_the_head_where_it_is(roll, head):
    truth = sleeper(torch.full((10,), roll), head)
    found = fit_bodies(FitInputs(seen(truth, "coco17", noise=4.0), CAMERA, open_body()), STARTED)
    along = (trunk_of(found.bodies.joints) * trunk_of(truth.joints)).sum(-1)
    assert along.min() > 0.9
    miss = found.bodies.joints[:, :22] - truth.joints[:, :22]
    assert (miss - miss[:, :1]).norm(dim=-1).mean() < 0.12


def test_of_a_stretch_of_lying_the_way_of_the_most_counts():
    stands, near, far = UP, torch.tensor([0.0, 0.0, -1.0]), torch.tensor([0.1, 0.0, 1.0])
    trunks = torch.stack([stands, near, far]).expand(9, 3, 3)
    best = torch.tensor([0, 2, 1, 2, 2, 0, 1, 1, 0])
    against = turned_round(trunks, best, UP)
    assert not against[:, 0].any()
    assert against[1:5, 1].all()
    assert not against[1:5, 2].any()
    assert against[6:8, 2].all()  # lying the other way after having stood
    assert not against[6:8, 1].any()
    assert not against[[0, 5, 8]].any()


def test_where_no_person_lies_nothing_is_against_anything():
    trunks = torch.stack([UP, torch.tensor([0.0, -0.7, 0.7])]).expand(4, 2, 3)
    assert not turned_round(trunks, torch.tensor([0, 1, 1, 0]), UP).any()
