"""Which feet give the floor: standing ones, not those that walk, sit or lie."""

import dataclasses
import logging
import math
from pathlib import Path

import pytest
import torch
from figures import ARMS_DOWN, SEATED, STRIDE, people, pose, turned

from mover.bodies.parts import parts_of
from mover.core.types import Bodies, Camera
from mover.geometry.camera import tilted
from mover.stages.camera.find_foot_contacts import (
    FootContactInputs,
    find_foot_contacts,
    straight_legs,
)
from mover.stages.config import FootContactConfig

SHARED = Path(__file__).parents[2] / "shared"
PITCH, ROLL, GROUND = math.radians(-12), math.radians(2), -1.5
K = torch.tensor([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]])
SPOTS = ((0.8, -2.5), (-0.9, -3.0), (0.2, -4.5), (-0.6, -2.2), (1.1, -3.9))


def camera_off(pitch=0.0, roll=0.0):
    angles = torch.tensor([PITCH + math.radians(pitch), ROLL + math.radians(roll)])
    return Camera(K, tilted(angles[0], angles[1]), 1280, 720)


def at(turns, spots, height=0.0, hold=3, orient=(0.0, 0.0, 0.0)):
    """People of one pose at several places, `hold` frames in each, `height` above the floor."""
    bodies = people(turned(pose(turns, len(spots) * hold), *orient), floor=GROUND + height)
    places = torch.tensor([[x, 0.0, z] for x, z in spots]).repeat_interleave(hold, 0)
    return dataclasses.replace(bodies, verts=bodies.verts + places[:, None], pose=None)


def filmed(*parts, fps=5.0, person=None):
    """The parts one after the other, in camera axes."""
    verts = torch.cat([p.verts for p in parts]) @ camera_off().R_cam_world.mT
    rows = torch.arange(len(verts))
    person = 0 * rows if person is None else person
    return Bodies(verts, parts[0].faces, None, (), rows, person, fps, "camera", None)


def soles_of(bodies, camera=None, keep=None, config=None):
    keep = torch.ones(len(bodies.frame), dtype=torch.bool) if keep is None else keep
    inputs = FootContactInputs(bodies, parts_of(bodies), keep, camera or camera_off(3.0, -3.0))
    return find_foot_contacts(inputs, config or FootContactConfig())


def heights_of(soles):
    return (soles.points_cam @ camera_off().R_cam_world)[:, 1] - GROUND


def test_only_the_soles_of_standing_people_are_found_though_others_are_nearer_the_floor():
    standing, sitting = at(ARMS_DOWN, SPOTS), at(SEATED, SPOTS, height=0.12)
    lying = at(ARMS_DOWN, SPOTS[:2], height=-0.1, orient=(-math.pi / 2, 0.0, 0.0))
    soles = soles_of(filmed(sitting, standing, lying))
    assert soles.warnings == ()
    assert sorted(soles.frame.unique().tolist()) == list(range(15, 30))
    assert soles.frame.bincount()[15:].unique().tolist() == [4]
    assert heights_of(soles).abs().max() < 0.015


def test_the_standing_leg_of_a_stride_carries_and_the_lifted_one_does_not():
    bodies = filmed(at({**STRIDE, "right_knee": (0.9, 0.0, 0.0)}, SPOTS))
    straight = straight_legs(bodies, parts_of(bodies), camera_off().R_cam_world[:, 1])
    assert straight[:, 0].all()
    assert not straight[:, 1].any()


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_feet_that_slide_with_a_moving_body_do_not_count(fps):
    walking, resting = at(ARMS_DOWN, [(0.0, -3.0)], hold=12), at(ARMS_DOWN, [(2.0, -3.0)], hold=12)
    steps = torch.arange(12)[:, None, None] * torch.tensor([1.3 / fps, 0.0, 0.0])
    walking = dataclasses.replace(walking, verts=walking.verts + steps)
    soles = soles_of(filmed(walking, resting, fps=fps))
    assert soles.frame.min() >= 12
    assert len(soles.frame.unique()) >= 11
    alone = soles_of(filmed(walking, fps=fps))
    assert len(alone.frame) == 48
    assert "no standing foot is ever still" in alone.warnings[0]


def test_jitter_of_a_resting_foot_is_no_motion():
    still = at(ARMS_DOWN, SPOTS[:1], hold=60)
    noise = torch.randn(60, 1, 3, generator=torch.Generator().manual_seed(0)) * 0.008
    bodies = filmed(dataclasses.replace(still, verts=still.verts + noise), fps=30.0)
    assert len(soles_of(bodies).frame.unique()) > 50


def test_seated_people_give_the_floor_only_where_no_person_stands():
    soles = soles_of(filmed(at(SEATED, SPOTS)))
    assert "no person ever stands" in soles.warnings[0]
    assert heights_of(soles).abs().max() < 0.02


def test_rejected_frames_and_other_people_do_not_count():
    bodies = filmed(at(ARMS_DOWN, SPOTS), person=torch.arange(15) % 2 + 4)
    keep = torch.ones(15, dtype=torch.bool)
    keep[[2, 7]] = False
    soles = soles_of(dataclasses.replace(bodies, fps=None), keep=keep)
    assert sorted(soles.frame.unique().tolist()) == [r for r in range(15) if r not in (2, 7)]
    assert torch.equal(soles.person, soles.frame % 2 + 4)
    none = soles_of(dataclasses.replace(bodies, fps=None), keep=keep & False)
    assert len(none.frame.unique()) == 15


def test_a_mesh_that_is_no_person_gives_its_lowest_points(caplog, monkeypatch):
    tall = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 1.8, 0]])
    tall = tall + torch.tensor([0, GROUND, -3])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    verts = tall[None].expand(4, -1, -1) @ camera_off().R_cam_world.mT
    rows = torch.arange(4)
    bodies = Bodies(verts, faces, None, (), rows, rows * 0, 5.0, "camera", None)
    monkeypatch.setattr("mover.stages.camera.find_foot_contacts.POINTS", 3)
    with caplog.at_level(logging.ERROR):
        soles = soles_of(bodies)
    assert heights_of(soles).abs().max() < 1e-5


def test_bodies_in_the_world_are_refused():
    bodies = dataclasses.replace(filmed(at(ARMS_DOWN, SPOTS)), space="world")
    with pytest.raises(ValueError, match="'camera' space, not 'world'"):
        soles_of(bodies)


@pytest.mark.slow
@pytest.mark.skipif(not (SHARED / "data/photo_bench").exists(), reason="no photograph here")
def test_the_dancer_of_a_photograph_stands_on_the_lower_foot():
    import numpy as np

    data = np.load(SHARED / "data/photo_bench/bodies.npz")
    rows = torch.zeros(1, dtype=torch.long)
    verts, faces = torch.from_numpy(data["vertices"]), torch.from_numpy(data["faces"]).long()
    bodies = Bodies(verts, faces, None, (), rows, rows, None, "camera", None)
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1, -1])), 1600, 898)
    soles = soles_of(bodies, camera)
    assert len(soles.frame) == 4
    assert float(verts[0, :, 1].max() - soles.points_cam[:, 1].min()) < 0.05
