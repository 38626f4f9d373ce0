"""Camera and ground from soles: analytic floors, noise, and what feet cannot observe."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from mover.core.types import Camera
from mover.energy.human_terms import FootContacts, feet_term, tilt_prior, up_cam
from mover.geometry.camera import pitch_roll, tilted
from mover.stages.camera.align_camera import (
    AlignInputs,
    PlanePrior,
    align_camera,
    cost_of,
    covariance_of,
    fit_plane,
    vote,
)
from mover.stages.config import AlignConfig

PITCH, ROLL, GROUND = math.radians(-11), math.radians(1.5), -1.6
K = torch.tensor([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]])
ROBUST = AlignConfig()
PAPER = AlignConfig(sigmas=(0.1,), tilt_prior=math.inf, offset_prior=0, votes="points")


def rotation(pitch, roll):
    return tilted(torch.tensor(pitch).double(), torch.tensor(roll).double())


def soles_at(spots, seed=0, frames=3, noise=0.0, wrong=0.0, person=0, bias=0.0):
    """Soles on the floor of a known camera: `frames` at every (x, z), four points each."""
    rng, points = np.random.default_rng(seed), []
    for x, z in spots:
        for _ in range(frames):
            y = GROUND + bias + rng.normal(0, noise)
            y += rng.uniform(0.1, 0.7) * (rng.random() < wrong)
            patch = rng.uniform(-0.04, 0.04, (4, 2))
            points += [(x + a, y, z + b) for a, b in patch]
    cam = torch.tensor(np.array(points)) @ rotation(PITCH, ROLL).mT
    frame = torch.arange(len(points)) // 4
    return FootContacts(cam.float(), torch.full_like(frame, person), frame, ())


def room(n=20, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([rng.uniform(-1.5, 1.5, n), -rng.uniform(2, 5, n)], -1)


def line(n=14, angle=0.4, feet=0.2):
    """A straight walk; the feet are `feet` [m] apart."""
    along, side = np.linspace(-1, 1, n), feet / 2 * (-1.0) ** np.arange(n)
    c, s = math.cos(angle), math.sin(angle)
    return np.stack([along * c - side * s, along * s + side * c - 3.5], -1)


def joined(*parts):
    points, person, frame = (
        torch.cat([getattr(p, name) for p in parts]) for name in ("points_cam", "person", "frame")
    )
    return FootContacts(points, person, frame, ())


def errors(found):
    """Errors of pitch and roll [degrees] and ground [m]."""
    pitch, roll = pitch_roll(found.camera.R_cam_world.double())
    return np.array([math.degrees(pitch - PITCH), math.degrees(roll - ROLL), found.ground - GROUND])


def align(soles, off, ground=None, height=None, config=ROBUST, **more):
    """From a camera that is so many degrees off."""
    pitch, roll = PITCH + math.radians(off[0]), ROLL + math.radians(off[1])
    camera = Camera(K, rotation(pitch, roll).float(), 1280, 720)
    return align_camera(AlignInputs(soles, camera, ground, height, **more), config)


def spread_of(found):
    """Of pitch and roll [degrees] and ground [m]."""
    return found.covariance.diag().sqrt().numpy() * [180 / math.pi, 180 / math.pi, 1]


@pytest.mark.parametrize("config", [AlignConfig(), PAPER], ids=["robust", "paper"])
@pytest.mark.parametrize("off", [(3.0, -4.0), (-4.0, 3.0), (20.0, -8.0)])
def test_a_clean_floor_is_found_from_any_guess(config, off):
    found = align(soles_at(room()), off, config=config)
    assert np.abs(errors(found)).max() < 0.02
    assert abs(errors(found)[2]) < 0.001


@pytest.mark.parametrize("ground", [None, -1.2, 0.4])
def test_outliers_and_a_wrong_ground_do_no_harm(ground):
    walked = soles_at(room(80), frames=2, noise=0.005, wrong=0.25)
    pitch, roll, floor = np.abs(errors(align(walked, (3.0, -3.0), ground)))
    assert max(pitch, roll) < 0.1
    assert floor < 0.005


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("spots", [line(feet=0.0), line(), line(angle=1.5)], ids=["0", "1", "2"])
def test_a_straight_walk_is_never_worse_than_the_guess(spots, seed):
    sign = (-1.0) ** seed, 1.0
    off = 3 * sign[0], 3 * sign[1]
    found = align(soles_at(spots, seed=seed, noise=0.01), off)
    assert np.linalg.norm(errors(found)[:2]) < np.linalg.norm(off)
    assert np.abs(errors(found)[:2]).max() < 3.6
    assert len(found.warnings) == 1
    assert "line" in found.warnings[0]


@pytest.mark.parametrize("config", [AlignConfig(), PAPER], ids=["robust", "paper"])
def test_one_frame_moves_only_the_ground(config):
    found = align(soles_at([(0.3, -3.0)], frames=1), (3.0, -2.0), config=config)
    if config is not PAPER:  # the paper has no prior: any tilt through four points is as good
        assert np.abs(errors(found)[:2] - [3, -2]).max() < 0.1
    world = soles_at([(0.3, -3.0)], frames=1).points_cam @ found.camera.R_cam_world
    assert abs(float(world[:, 1].mean()) - found.ground) < 2e-3
    assert "single frame" in found.warnings[0]


@pytest.mark.parametrize("bias", [0.03, -0.03])
@pytest.mark.parametrize("apart", [True, False])
def test_two_people_with_opposite_depth_bias_are_never_worse_than_the_guess(bias, apart):
    side, other = room(15, seed=1), room(15, seed=2)
    if apart:
        side, other = side * [0.3, 1] + [1, 0], other * [0.3, 1] - [1, 0]
    soles = joined(
        soles_at(side, noise=0.01, person=4, bias=bias),
        soles_at(other, noise=0.01, person=9, bias=-bias, seed=5),
    )
    found = align(soles, (2.0, -2.0))
    assert np.abs(errors(found)[:2]).max() < (1.8 if apart else 0.4)
    assert abs(errors(found)[2]) < 0.02
    assert found.offsets.keys() == {"4", "9"}
    assert abs(found.offsets["4"] + found.offsets["9"]) < 1e-6
    if not apart:
        assert abs(found.offsets["4"] - bias) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("frames", "noise"), [(1, 0.015), (6, 0.02)])
def test_the_covariance_is_calibrated(frames, noise):
    rng, scores = np.random.default_rng(3), []
    for seed in range(200):
        soles = soles_at(room(15, seed), seed=seed + 999, frames=frames, noise=noise)
        found = align(soles, rng.normal(0, 3, 2))
        scores.append(np.abs(errors(found)) < 1.645 * spread_of(found))
    assert (np.mean(scores, 0) >= 0.80).all()
    assert (np.mean(scores, 0) <= 0.97).all()


def leaning(soles, slope):
    """The same, of bodies whose distance is wrong by a share that grows with it [1/m]."""
    points = soles.points_cam
    away = points.norm(dim=-1, keepdim=True)
    return FootContacts(points * (1 + slope * (away - away.mean())), soles.person, soles.frame, ())


@pytest.mark.parametrize("slope", [-0.007, 0.007])
def test_a_floor_that_leans_as_a_whole_is_set_right_by_a_tilt_that_is_observed(slope):
    observed, soles = math.radians(0.3), leaning(soles_at(room(30), noise=0.01), slope)
    alone = errors(align(soles, (0.1, -0.1)))
    assert abs(alone[0]) > 0.4  # and states a tenth of that
    fixed, free = (
        align(soles, (0.1, -0.1), tilt_spread=observed, lean=lean)
        for lean in (0.0, math.radians(0.5))
    )
    assert abs(errors(free)[0]) < 0.2 < abs(errors(fixed)[0])
    spread = free.covariance.diag().sqrt()[:2]
    assert bool((spread > 0.8 * observed).all())
    assert bool((spread < 1.2 * observed).all())


def test_a_lean_that_all_feet_share_is_in_the_covariance():
    lean, soles = math.radians(2.0), soles_at(room(), noise=0.01)
    plain, shared = (align(soles, (0.5, -0.5), lean=value) for value in (0.0, lean))
    assert bool((shared.covariance.diag()[:2].sqrt() > 0.6 * lean).all())
    assert bool((plain.covariance.diag()[:2].sqrt() < 0.3 * lean).all())
    # the plane turns about the middle of the feet: pitch and ground err together
    R = plain.camera.R_cam_world.to(soles.points_cam)
    away = float((soles.points_cam @ R)[:, 2].mean().abs())
    ground = float(shared.covariance[2, 2].sqrt() / shared.covariance[0, 0].sqrt())
    assert ground == pytest.approx(away, rel=0.15)
    correlation = shared.covariance[0, 2] / shared.covariance.diag()[[0, 2]].prod().sqrt()
    assert abs(float(correlation)) > 0.9
    level = AlignConfig(level=True)  # as most cameras are
    plain, usual = (align(soles, (0.5, 1.0), config=c, lean=lean) for c in (ROBUST, level))
    assert abs(errors(plain)[1]) < 0.2 < errors(usual)[1] < 0.9
    assert abs(errors(align(soles, (0.5, 9.0), config=level, lean=lean))[1]) < 1.5  # not all


@pytest.mark.parametrize("turn", [(1.5, 0.0), (-1.5, 1.0), (0.0, 0.0)])
def test_the_ground_under_another_tilt_is_where_the_same_feet_are(turn):
    soles = soles_at(room(), noise=0.01)
    found = align(soles, (0.5, -0.5), tilt_spread=0.035)
    pitch, roll = (float(x) for x in pitch_roll(found.camera.R_cam_world))
    at = [torch.tensor(x + math.radians(t)) for x, t in zip((pitch, roll), turn, strict=True)]
    R = tilted(at[0], at[1])
    other = replace(found.camera, R_cam_world=R.to(found.camera.R_cam_world))
    ground, spread = found.ground_under(other)
    assert ground == pytest.approx(float((soles.points_cam.to(R) @ R)[:, 1].mean()), abs=0.02)
    assert spread <= float(found.covariance[2, 2]) ** 0.5 + 1e-6


def test_frames_of_one_pose_are_no_new_evidence():
    rng = np.random.default_rng(0)
    spots = room(8)
    parts = [
        soles_at([s], frames=40, noise=0.002, bias=rng.normal(0, 0.015), seed=i)
        for i, s in enumerate(spots)
    ]
    stood = joined(*parts)
    stood = FootContacts(stood.points_cam, stood.person, torch.arange(len(stood.person)) // 4, ())
    found = align(stood, (2.0, 2.0))
    assert (np.abs(errors(found)) < 2.5 * spread_of(found)).all()
    assert spread_of(found)[1] > 0.2


def test_a_known_camera_height_is_the_ground_and_people_of_a_wrong_size_are_reported():
    soles = soles_at(room(), noise=0.005, bias=-0.08)
    found = align(soles, (2.0, -2.0), height=-GROUND)
    assert found.ground == GROUND
    assert np.abs(errors(found)[:2]).max() < 0.5
    assert found.offsets["0"] == pytest.approx(-0.08, abs=0.015)
    assert any("person 0 stands 8 cm below the floor" in w for w in found.warnings)


def test_without_feet_everything_stays_and_a_warning_says_so():
    none = torch.zeros(0, dtype=torch.long)
    soles = FootContacts(torch.zeros(0, 3), none, none, ())
    for ground, height, expected in ((-1.3, None, -1.3), (-1.3, 1.4, -1.4), (None, None, -1.5)):
        found = align(soles, (1.0, 2.0), ground, height)
        assert np.allclose(errors(found)[:2], [1, 2], atol=1e-4)
        assert found.ground == expected
        assert "no feet" in found.warnings[0]


def test_the_result_is_a_minimum_of_feet_term_and_prior():
    votes = vote(soles_at(room(), noise=0.02, wrong=0.2), "places")
    prior = PlanePrior(torch.tensor([PITCH + 0.05, ROLL - 0.05]).double(), 0.07, 0.03, None)
    start = torch.tensor([PITCH, ROLL, GROUND, 0.0]).double()
    fit = fit_plane(votes, prior, start, (0.1, 0.02), 60)
    at = fit.at.clone().requires_grad_()
    cost_of(at, votes, prior, 0.02).backward()
    assert at.grad.abs().max() < 1e-4 * votes.weight.sum() * 0.02
    around = [
        float(cost_of(fit.at + d, votes, prior, 0.02))
        for d in 1e-3 * torch.randn(50, 4, generator=torch.Generator().manual_seed(0)).double()
    ]
    assert min(around) >= fit.cost
    assert torch.linalg.eigvalsh(covariance_of(fit, votes).double()).min() > 0


def test_the_term_is_the_printed_formula_point_by_point():
    soles, rng = soles_at(room(3)), np.random.default_rng(0)
    R, ground = rotation(-0.2, 0.1), -1.4
    offset = torch.from_numpy(rng.normal(0, 0.1, 36)).float()
    got = feet_term(soles, R[None].float(), torch.tensor([ground]), offset, 0.1)[0]
    for i, point in enumerate(soles.points_cam.double().numpy()):
        r = (R.numpy().T @ point)[1] - ground - float(offset[i])
        assert float(got[i]) == pytest.approx(r**2 / (r**2 + 0.01), abs=1e-5)
    up = up_cam(torch.tensor([-0.2]).double(), torch.tensor([0.1]).double())
    assert torch.allclose(up[0], R[:, 1])
    for off, cost in ((0.0, 0.0), (0.007, 0.5 * 0.01)):
        pitch, roll = torch.tensor([[0.0], [0.05 + off]]).double()
        prior = tilt_prior(pitch, roll, torch.tensor([0.0, 0.05]).double(), 0.07)
        assert float(prior) == pytest.approx(cost, rel=0.01)
