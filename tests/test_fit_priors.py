"""What the fit knows beyond keypoints: rest, level feet, which way people lie; and noise."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from make_keypoints import CAMERA, as_bodies, keypoints_at, seen, walker
from test_fit import QUICK

from mover.bodies.skeleton import BODY
from mover.bodies.skinning import growth_of, open_body
from mover.core.types import Bodies
from mover.energy.body_terms import BODY_TERMS, SIGMA_HELD, deviation_term, robust_square
from mover.evaluate.bodies import procrustes
from mover.fitting import STAGES, FitConfig, Stage, energy, priors
from mover.fitting.bodies import FEW, FitInputs, at_most, bias_of, fit_bodies, noise_of, without
from mover.fitting.energy import HEIGHT, UPPER, Seen
from mover.fitting.start import BACK, LEGS, lying_guesses, turned_round, upright_guesses
from mover.fitting.tracks import CALM, joint_speed, motion_of, stages_of
from mover.fitting.unknowns import NO_FLOOR, Frame, Unknowns, floor_of, rig_of
from mover.geometry.rotations import axis_angle, rot_x, rot_y, rot_z, rotation_vectors

REST = priors.resting(1, torch.zeros(1))
UP = torch.tensor([0.0, -1.0, 0.0])


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_the_speed_in_the_image_is_that_of_most_joints_whatever_the_frame_rate(fps):
    generator = torch.Generator().manual_seed(0)
    frame = torch.arange(0, int(4 * fps))
    time = frame / fps
    points = 100 * torch.rand(17, 2, generator=generator).expand(len(frame), 17, 2).clone()
    points[..., 0] += 60 * (time - 2).clamp_min(0)[:, None]  # stands for two seconds, then walks
    points[:, :4, 1] += 50 * (9 * time).sin()[:, None]  # an arm that waves is not the body
    noisy = points + 2 * torch.randn(points.shape, generator=generator)
    there = torch.ones(len(frame), 17, dtype=torch.bool)
    there[:, 9] = False
    speed = joint_speed(keypoints_at(frame, fps, noisy), there)
    assert torch.isinf(speed[[0, -1]]).all()
    stands, walks = speed[(time > 0) & (time < 1.4)], speed[(time > 2.6) & (time < 3.7)]
    assert stands[:, UPPER[:5]].max() < 12  # no keypoint shows the trunk
    assert (walks[:, 0] - 60).abs().max() < 12
    wrists = [BODY.index(f"{side}_wrist") for side in ("left", "right")]  # keypoints 9 and 10
    assert torch.isinf(speed[:, wrists[0]]).all()
    assert stands[:, wrists[1]].max() < 20
    assert (speed >= speed[:, :1]).all()
    feet = [BODY.index(f"left_{part}") for part in ("ankle", "foot")]
    torch.testing.assert_close(speed[:, feet[0]], speed[:, feet[1]])


@pytest.mark.slow
def test_a_body_along_the_view_does_not_jump_between_frames_that_look_similar():
    pose, frame = walker(12)
    lying = axis_angle(torch.tensor([[-1.35, 0.0, 0.0]])) @ axis_angle(pose.global_orient[:1])
    still = dataclasses.replace(
        pose,
        global_orient=rotation_vectors(lying).expand(12, 3).clone(),
        body_pose=pose.body_pose[:1].expand(12, -1).clone(),
        transl=pose.transl[:1].expand(12, 3).clone(),
    )
    keypoints = seen(as_bodies(still, frame), noise=4.0)
    # No hands are seen; a floor would hold the body in part, too.
    coarse = dataclasses.replace(QUICK, stages=QUICK.stages[:1], stands=0.0)
    inputs, jumps, arms = FitInputs(keypoints, CAMERA, open_body()), list[float](), list[float]()
    free = dataclasses.replace(coarse, held=0.0)
    for config in (free, dataclasses.replace(free, still=0.0), coarse):
        joints = fit_bodies(inputs, config).bodies.joints
        jumps.append(float(joints[:, 0, 2].diff(n=2).std()))
        wrists = joints[:, [BODY.index(f"{side}_wrist") for side in ("left", "right")]]
        arms.append(float(wrists.diff(n=2, dim=0).norm(dim=-1).mean()))
    assert jumps[0] < 0.3 * jumps[1]
    assert jumps[2] < 0.3 * jumps[1]
    assert arms[2] < 0.6 * arms[1]
    assert arms[2] < arms[0]


def test_limbs_that_look_still_are_held_and_no_others():
    row, time = torch.arange(5), torch.arange(5) / 5.0
    joints = torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(1)).expand(5, 22, 3)
    slow = torch.zeros(5, 22)
    fast = torch.full((5, 22), torch.inf)

    held = next(term.cost for term in BODY_TERMS if term.name == "held")

    def cost(moved: torch.Tensor, speed: torch.Tensor) -> float:
        motion = motion_of(keypoints_at(row, 5.0), speed, FitConfig())
        return float(held(SimpleNamespace(sized=moved, upper=UPPER, motion=motion)).sum())

    steady = joints + time[:, None, None]
    assert cost(steady, slow) < 1e-6  # all of it moves evenly
    leg, arm, whole = steady.clone(), steady.clone(), steady.clone()
    leg[2, BODY.index("left_ankle")] += 0.1
    arm[2, BODY.index("left_wrist"), 2] += 0.1
    whole[2] += 0.1
    assert cost(leg, slow) < 1e-6
    assert cost(whole, slow) < 1e-6  # which is penalised by `still`
    second = torch.tensor([0.1, 0.2, 0.1]).square()
    calm = FitConfig().jitter + CALM / 25
    wanted = robust_square(second, SIGMA_HELD).sum() / calm**2
    assert cost(arm, slow) == pytest.approx(float(wanted), rel=1e-4)
    assert cost(arm, fast) < 0.02 * cost(arm, slow)


def test_an_ankle_that_levels_the_foot_costs_no_more_than_one_at_rest():
    rest, spread = REST, priors.spreads(1, REST)
    bent, level = rest.clone(), rest.clone()
    for joint, turn in (("left_hip", -0.7), ("left_knee", 1.0)):
        column = 3 * (BODY.index(joint) - 1)
        bent[0, column] += turn
        level[0, column] += turn
    level[0, 3 * (BODY.index("left_ankle") - 1)] -= 0.3
    costs = [deviation_term(priors.off_pose(pose, REST), spread) for pose in (rest, bent, level)]
    assert float(costs[0]) == 0
    assert float(costs[1] - costs[2]) == pytest.approx((0.3 / math.radians(14)) ** 2)


def lying_down(depths, rises):
    """Joints of a track whose trunk rises so [rad] along the view, at these distances [m]."""
    rises = torch.as_tensor(rises)
    joints = torch.zeros(len(rises), 22, 3)
    joints[..., 2] = torch.as_tensor(depths)[:, None]
    joints[:, BODY.index("neck"), 1] -= 0.5 * rises.sin()
    joints[:, BODY.index("neck"), 2] += 0.5 * rises.cos()
    return joints


def expected_distances(joints):
    rows = torch.arange(len(joints))
    return energy.distances_of_lying_people(joints, UP, [rows], rows / 5)


def test_a_person_lying_along_the_view_is_expected_where_they_sat_before_and_after():
    upright = [1.5] * 4
    joints = lying_down([4.0] * 4 + [4.9] * 5 + [4.4] * 4, upright + [0.0] * 5 + upright)
    found = expected_distances(joints)
    assert found[:4].isnan().all()
    assert found[9:].isnan().all()
    between = torch.linspace(math.log(4.0), math.log(4.4), 7)[1:-1]
    torch.testing.assert_close(found[4:9], between)
    assert expected_distances(joints[4:9]).isnan().all()  # it is not known where they came from


def test_a_body_across_the_view_shows_its_distance_itself():
    joints = lying_down([4.0, 4.9, 4.0], [1.5, 0.0, 1.5])
    joints[1, BODY.index("neck")] = torch.tensor([0.5, 0.0, 4.9])
    assert expected_distances(joints).isnan().all()


def test_a_leaning_floor_lies_where_its_soles_are():
    up = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, 0.2]), dim=0)
    leaned, height = energy.plane_of(torch.tensor([0.05, -0.03, -1.4]), up, None)
    assert float(leaned.norm()) == pytest.approx(1)
    assert float(leaned @ up) == pytest.approx(1 / math.sqrt(1 + 0.05**2 + 0.03**2))
    assert float(height) == pytest.approx(-1.4)
    joints = torch.zeros(1, 22, 3)
    soles = energy.soles_of(open_body())
    for side, more in (("left", 0.2), ("right", 0.0)):  # the left foot is lifted
        for joint, over in zip(("ankle", "foot"), soles, strict=True):
            joints[0, BODY.index(f"{side}_{joint}")] = (height + over + more) * leaned
    assert float(energy.sole_heights(joints, soles, leaned)) == pytest.approx(-1.4, abs=1e-5)


def test_upright_bodies_are_symmetric_and_nearly_straight_where_they_stand():
    poses = torch.stack([guess.pose for guess in upright_guesses(torch.zeros(1))[::4]])
    assert not priors.excess_of(poses).any()
    mirrored = poses.unflatten(-1, (21, 3)) * torch.tensor([1.0, -1.0, -1.0])
    other = [name.replace("left", "+").replace("right", "left").replace("+", "right")
             for name in BODY[1:]]  # fmt: skip
    swapped = mirrored[:, [BODY.index(name) - 1 for name in other]].flatten(1)
    torch.testing.assert_close(swapped, poses)
    axes = [3 * (BODY.index(f"left_{joint}") - 1) for joint in ("hip", "knee")]
    stand, sit = poses[:, axes].rad2deg().abs()
    assert stand.max() <= 20 < 75 <= sit.min()


def test_only_lying_people_have_arms_anywhere_in_their_ranges():
    like = torch.zeros(1, dtype=torch.float64)
    usual, generator = priors.spreads(1, like)[0], np.random.default_rng(0)
    low, high = (x.numpy() for x in priors.limit_table()[:2])
    drawn = generator.uniform(low, high, (200_000, 63)).std(0)
    arms = torch.tensor(["shoulder" in name for name in BODY[1:]]).repeat_interleave(3)
    for guess in lying_guesses(like, BACK):
        np.testing.assert_allclose(guess.spread[arms], drawn[arms.numpy()], rtol=0.01)
        assert torch.equal(guess.spread[~arms], usual[~arms])
    usual[[*priors.HIPS, *priors.KNEES]] = LEGS
    assert all(torch.equal(guess.spread, usual) for guess in upright_guesses(like))


# Which way the head is, and what lying people are rolled to.

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
    along = (energy.trunk_of(found.bodies.joints) * energy.trunk_of(truth.joints)).sum(-1)
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
    trunks = torch.stack([UP, torch.tensor([0.0, -0.7, 0.7])]).expand(4, 2, 3)  # no person lies
    assert not turned_round(trunks, torch.tensor([0, 1, 1, 0]), UP).any()


# Noise of keypoints: how large it is, how much it lets them weigh, what it makes of bodies.

LEFT = 0.45


def looked_at(weight):
    none = torch.zeros(len(weight), weight.shape[1], 2)
    rest = priors.resting(len(weight), none)
    return Seen(
        none, weight, torch.eye(3), 540, torch.tensor([0.0, -1, 0]), None, rest,
        priors.spreads(len(weight), none),
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
    off, true = list[float](), walk.joints[:, :22]
    for config in (quick, dataclasses.replace(quick, left=0.0)):
        found = fit_bodies(inputs, config).bodies.joints[:, :22]
        off.append(float((procrustes(found, true) - true).norm(dim=-1).mean()))
    assert off[0] < 0.95 * off[1]
