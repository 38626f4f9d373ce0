"""Noise of keypoints: how large it is, how much it lets them weigh, what it makes of bodies."""

import dataclasses
import math

import pytest
import torch
from make_keypoints import CAMERA, as_bodies, seen, walker

from mover.bodies.skinning import growth_of, open_body
from mover.evaluate.bodies import procrustes
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import STAGES, FitConfig, Stage
from mover.fitting.energy import HEIGHT, Seen
from mover.fitting.noise import FEW, at_most, bias_of, noise_of, without
from mover.fitting.priors import resting, spreads
from mover.fitting.tracks import stages_of
from mover.fitting.unknowns import NO_FLOOR, Frame, Unknowns, floor_of, rig_of

LEFT = 0.45


def looked_at(weight):
    none = torch.zeros(len(weight), weight.shape[1], 2)
    rest = resting(len(weight), none)
    return Seen(
        none, weight, torch.eye(3), 540, torch.tensor([0.0, -1, 0]), None, rest,
        spreads(len(weight), none),
    )  # fmt: skip


def unknowns(rows, people=1, floor=NO_FLOOR):
    none = torch.zeros(rows, 0)
    return Unknowns(torch.zeros(rows, 3), torch.zeros(rows, 63), torch.zeros(rows, 3),
                    torch.zeros(people, 10), none, none, floor)  # fmt: skip


def test_the_noise_of_each_person_is_found_beside_swaps_and_missing_joints():
    generator = torch.Generator().manual_seed(0)
    person = torch.arange(400) % 2
    true = torch.where(person == 0, 3.0, 6.0)
    off = math.sqrt(LEFT) * true[:, None, None] * torch.randn(400, 17, 2, generator=generator)
    off[:, 5] += 80  # a joint that is elsewhere
    off[:, 3] = 1e3
    weight = torch.ones(400, 17)
    weight[:, 3] = 0  # not seen
    found = noise_of(off, looked_at(weight), person, LEFT)
    assert (found / true - 1).abs().max() < 0.15
    assert float(noise_of(off, looked_at(0 * weight), person, LEFT).max()) == 0


def test_a_keypoint_off_by_its_noise_costs_no_more_than_an_angle_off_by_its_spread():
    weight = torch.tensor([[0.9, 0.2, 0.0], [0.9, 0.2, 0.0]])
    bounded = at_most(looked_at(weight), torch.tensor([6.0, 0.0]), pose=4.78)
    cost = (HEIGHT / 540) ** 2 * bounded[0].square() * 6.0**2
    assert float(cost[0]) == pytest.approx(4.78**2, rel=1e-5)
    torch.testing.assert_close(bounded[0, 1:], weight[0, 1:])  # those that are less sure stay
    torch.testing.assert_close(bounded[1], weight[1])


def test_what_a_second_fit_changes_is_taken_off_the_first_as_far_as_it_is_known():
    person = torch.tensor([0] * 40 + [1] * 60)
    nearer, taller = torch.tensor([-0.03, 0.02]), torch.tensor([0.4, -0.2])
    found = unknowns(100, people=2)
    place, betas = found.place.clone(), found.betas.clone()
    place[:, 2] += nearer[person]
    place[::9, 2] += 1.0  # bodies that went astray
    betas[:, 0] += taller
    again = dataclasses.replace(found, place=place, betas=betas)
    share = torch.tensor([1.0, 0.5])
    mended = without(found, bias_of(found, again, person, share[person]), person)
    known = share * torch.tensor([40.0, 60.0]) / (torch.tensor([40.0, 60.0]) + FEW)
    torch.testing.assert_close(mended.place[:, 2], -(known * nearer)[person])
    torch.testing.assert_close(mended.betas[:, 0], -known * taller)


def test_the_floor_is_as_much_lower_as_people_are_taller():
    rig = rig_of(open_body(), "coco17", torch.ones(17, dtype=torch.bool))
    growth = growth_of(open_body())
    frame = Frame(rig, torch.eye(3)[None], torch.zeros(1, dtype=torch.long), growth)
    at = unknowns(1, floor=torch.tensor([0.1, -0.1, -1.4]))
    tall = dataclasses.replace(at, betas=math.log(1.1) * growth[None] / growth.square().sum())
    torch.testing.assert_close(floor_of(at, frame), at.floor)
    torch.testing.assert_close(floor_of(tall, frame), torch.tensor([0.1, -0.1, -1.54]))


def test_a_last_stage_is_spared_where_no_hand_or_face_is_seen():
    body, hands = ("left_knee", "nose"), ("left_knee", "left_index1")
    assert stages_of(FitConfig(), body) == STAGES[:-1]
    assert stages_of(FitConfig(), hands) == STAGES
    assert stages_of(FitConfig(stages=(Stage(),)), body) == (Stage(),)


@pytest.mark.slow
def test_poses_follow_the_noise_of_keypoints_less():
    pose, frame = walker(24)
    walk = as_bodies(pose, frame)
    quick = FitConfig(
        start_steps=15, noise_steps=60,
        stages=tuple(dataclasses.replace(s, steps=60) for s in STAGES[:2]),
    )  # fmt: skip
    inputs = FitInputs(seen(walk, noise=8.0), CAMERA, open_body())
    off = []
    for config in (quick, dataclasses.replace(quick, left=0.0)):
        found = fit_bodies(inputs, config).bodies.joints[:, :22]
        off.append(
            float(
                (procrustes(found, walk.joints[:, :22]) - walk.joints[:, :22]).norm(dim=-1).mean()
            )
        )
    assert off[0] < 0.95 * off[1]
