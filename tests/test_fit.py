"""The fit of bodies to keypoints."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from make_keypoints import (
    CAMERA,
    as_bodies,
    keypoints_at,
    leg_columns,
    random_pose,
    seen,
    walker,
)
from make_smpl import make_model, write_npz

from mover.bodies.keypoints import LAYOUTS, keypoints_of
from mover.bodies.skinning import heights_of, open_body, shaped
from mover.bodies.smpl_files import load_smpl
from mover.core.errors import InputError
from mover.core.types import Scene
from mover.energy.body_terms import BODY_TERMS, deviation_term, robust_square, second_difference
from mover.fitting import PAPER, PUBLISHED, STAGES, FitConfig, Stage, priors
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.energy import FitState, balance_cost, center_of_mass, standing_share
from mover.fitting.start import placed
from mover.fitting.tracks import best_path, motion_of, seen_of
from mover.fitting.unknowns import Frame, Unknowns, place_of, points_of, rig_of
from mover.geometry.camera import project
from mover.geometry.rotations import axis_angle, rot_x
from mover.io.capture.scene_file import write_scene

QUICK = FitConfig(
    start_steps=20,
    noise_steps=20,
    stages=(dataclasses.replace(STAGES[0], steps=25), dataclasses.replace(STAGES[1], steps=50)),
)

SURE = dataclasses.replace(QUICK, noise_steps=100)
"""Statures, and so distances, are known as well as keypoints allow."""
TERM = {term.name: term.cost for term in BODY_TERMS}
FEW = FitConfig(start_steps=2, stages=(dataclasses.replace(STAGES[1], steps=5),))
"""Enough to see that it runs, not to be right."""


def off(found, truth):
    """Mean distance of the joints about the pelvis, and with nothing aligned [m]."""
    miss = found.bodies.joints[:, :22] - truth.joints[found.rows][:, :22]
    return float((miss - miss[:, :1]).norm(dim=-1).mean()), float(miss.norm(dim=-1).mean())


def fit(keypoints, config=QUICK, start=None, model=None, **more):
    return fit_bodies(FitInputs(keypoints, CAMERA, model or open_body(), start, **more), config)


def state_of(keypoints, pose, betas=None, person=None, config=None):
    """Bodies in these poses, all of whose 25 keypoints are fitted."""
    config, rows = config or FitConfig(), len(keypoints.frame)
    rig = rig_of(open_body(), "openpose25", torch.ones(25, dtype=torch.bool))
    person, none = keypoints.person if person is None else person, torch.zeros(rows, 0)
    at = Unknowns(
        torch.zeros(rows, 3), pose.body_pose[:rows], torch.ones(rows, 3),
        torch.zeros(1, 10) if betas is None else betas, none, none,
    )  # fmt: skip
    frame = Frame(rig, axis_angle(pose.global_orient[:rows]), person)
    return FitState(at, frame, seen_of(keypoints, rig, CAMERA, config), config)


@pytest.fixture(scope="module")
def walk():
    return as_bodies(*walker())


@pytest.fixture(scope="module")
def sharp(walk):
    """Keypoints of the walk with little noise, and what is fitted to them."""
    keypoints = seen(walk, noise=1.0)
    return keypoints, fit(keypoints)


@pytest.mark.slow
def test_lasting_offsets_of_a_detector_do_not_change_the_stature(sharp):
    keypoints, true = sharp
    height = keypoints.points[..., 1].amax(1) - keypoints.points[..., 1].amin(1)
    names = LAYOUTS[keypoints.layout]
    off = torch.zeros_like(keypoints.points)
    for name, share in (("hip", -0.02), ("shoulder", 0.015), ("knee", 0.015)):
        for side in ("left", "right"):  # a longer thigh and a shorter trunk: proportions of giants
            off[:, names.index(f"{side}_{name}"), 1] = share * height
    wrong = dataclasses.replace(keypoints, points=keypoints.points + off)
    usual, dirs = heights_of(open_body())
    right, biased = (usual + float(f.bodies.pose.betas[0] @ dirs) for f in (true, fit(wrong)))
    assert abs(biased - right) < 0.04
    assert 1.5 < biased < 1.85


def test_the_shape_costs_its_proportions_and_the_height_beside_those_of_adults():
    usual, dirs = heights_of(open_body())
    two = torch.arange(2)
    unknown = priors.stature_of(open_body(), (), two, two)
    taller = (1.72 - usual) * dirs / dirs.square().sum()  # as far as it is held to the mean
    aside = torch.zeros(10)
    aside[[0, 2]] = torch.stack([-dirs[2], dirs[0]]) / dirs[[0, 2]].norm()
    betas = torch.stack([taller, taller + 2 * aside])
    torch.testing.assert_close(priors.shape_cost(unknown, betas), torch.tensor([1.0, 5.0]))
    cost = priors.shape_cost(priors.stature_of(open_body(), (1.72,), two, two), betas)
    torch.testing.assert_close(cost, torch.tensor([0.0, 4.0]), atol=1e-4, rtol=0)


def test_a_body_that_leans_as_a_whole_falls_and_one_that_stands_does_not(walk):
    joints = walk.joints[:, :22]
    up = CAMERA.R_cam_world[:, 1].float()
    assert standing_share(joints, up).median() == 1
    feet = joints[:, [7, 8, 10, 11]].mean(1)
    assert balance_cost(joints, up).sqrt().median() < 0.06
    lean = math.radians(20)
    turned = (joints - feet[:, None]) @ rot_x(torch.tensor(lean)).mT + feet[:, None]
    high = ((center_of_mass(joints) - feet) @ up).median()
    moved = balance_cost(turned, up).sqrt().median()
    assert float(moved) == pytest.approx(float(high) * math.sin(lean), abs=0.06)
    lying = (joints - feet[:, None]) @ rot_x(torch.tensor(math.pi / 2)).mT
    assert standing_share(lying, up).max() == 0


def test_offsets_cost_their_squared_deviations_by_the_name_of_the_keypoint():
    lasting = priors.lasting_of(("left_hip", "nose", "left_index3"))
    assert lasting.tolist() == pytest.approx([0.03, 0.015, 0.003])
    every = lasting[:, None].expand(3, 3).reshape(1, 9)
    assert float(deviation_term(every, lasting.repeat_interleave(3))) == pytest.approx(9)


@pytest.mark.parametrize("name", ["makehuman", pytest.param("smplx", marks=pytest.mark.slow)])
def test_the_rig_puts_keypoints_and_joints_where_the_whole_body_has_them(name, tmp_path):
    """Of SMPL-X with its hands, face, correctives and expression."""
    model, layout, count = open_body(), "openpose25", 22
    if name == "smplx":
        file = write_npz(make_model(name), tmp_path / "SMPLX_NEUTRAL.npz")
        model, layout, count = load_smpl(name, place=file), "smplifyx118", 55
    some = random_pose(model, 3, size=0.5)
    extra = {key: value for key, value in some.extra.items() if key == "expression"}
    away = some.transl + torch.tensor([0.0, 0.0, 6.0])
    pose, none = dataclasses.replace(some, transl=away, extra=extra), torch.zeros(3, 0)
    verts, joints = model.posed(pose)
    rig = rig_of(model, layout, torch.ones(len(LAYOUTS[layout]), dtype=torch.bool))
    face = torch.cat([torch.zeros(3, 3), *extra.values()], -1) if extra else none
    place = place_of(joints[:, 0])
    at = Unknowns(torch.zeros(3, 3), pose.body_pose, place, pose.betas, none, face)
    points = points_of(at, Frame(rig, axis_angle(pose.global_orient), torch.arange(3)))
    torch.testing.assert_close(points.joints, joints[:, :count], atol=2e-5, rtol=0)
    about = points.keypoints - points.joints[:, :1]
    wanted = keypoints_of(model, verts, joints, layout) - joints[:, :1]
    torch.testing.assert_close(about, wanted, atol=1e-5, rtol=0)


@pytest.mark.slow
def test_bodies_are_found_from_keypoints_alone(walk):
    found = fit(seen(walk, noise=3.0, missing=0.1), None)
    aligned, absolute = off(found, walk)
    assert aligned < 0.06
    assert absolute < 1.1 * priors.UNKNOWN * 4.0  # size and distance look the same: adults at 4 m
    assert found.miss.mean() < 5
    assert found.bodies.pose.betas.unique(dim=0).shape[0] == 1
    verts, joints = open_body().posed(found.bodies.pose)
    torch.testing.assert_close(verts, found.bodies.verts, atol=1e-5, rtol=0)
    front = axis_angle(found.bodies.pose.global_orient)[..., 2]
    true = axis_angle(walk.pose.global_orient)[..., 2]
    assert ((front * true).sum(-1) > 0.9).all()
    up = joints @ CAMERA.R_cam_world[:, 1]
    assert (up[:, 15] > up[:, 10] + 1.2).all()


@pytest.mark.slow
@pytest.mark.parametrize("yaw", [0.0, 1.6, 3.1])
def test_people_are_not_turned_about(yaw):
    truth = as_bodies(*walker(4, yaw=yaw))
    out = fit(seen(truth, noise=2.0))
    front = axis_angle(out.bodies.pose.global_orient)[..., 2]
    assert ((front * axis_angle(truth.pose.global_orient)[..., 2]).sum(-1) > 0.85).all()


@pytest.mark.slow
def test_bodies_of_another_tool_are_put_under_the_true_camera(walk):
    rng = torch.Generator().manual_seed(3)
    wrong = dataclasses.replace(
        walk.pose,
        body_pose=walk.pose.body_pose + 0.12 * torch.randn(12, 63, generator=rng),
        transl=walk.pose.transl * 3.0,  # a weak-perspective tool's long lens
        betas=torch.zeros_like(walk.pose.betas),
    )
    start = as_bodies(wrong, walk.frame)
    before = (start.joints - start.joints[:, :1] - walk.joints + walk.joints[:, :1])[:, :22]
    out = fit(seen(walk, noise=2.0), QUICK, start)
    aligned, absolute = off(out, walk)
    assert aligned < 0.6 * float(before.norm(dim=-1).mean())
    assert absolute < 0.25


@pytest.mark.slow
def test_legs_of_a_sitter_that_no_row_shows_stay_as_they_were_before_and_after():
    pose, frame = walker(9)
    angles = pose.body_pose.reshape(9, 21, 3).clone()
    angles[:, :2, 0], angles[:, 3:5, 0] = -1.4, 1.4
    still = dataclasses.replace(
        pose, body_pose=angles.reshape(9, 63), transl=pose.transl[4:5].expand(9, 3).clone()
    )
    truth = as_bodies(still, frame)
    keypoints = seen(truth, noise=1.0)
    sure = keypoints.confidence.clone()
    sure[3:6, leg_columns()] = 0
    hidden = dataclasses.replace(keypoints, confidence=sure)
    out = fit(hidden)
    miss = out.bodies.joints - truth.joints
    about = (miss - miss[:, :1])[:, [4, 5, 7, 8]].norm(dim=-1).mean(1)
    assert about[3:6].mean() < about[:3].mean() + 0.05


@pytest.mark.slow
def test_two_people_keep_their_own_shapes_and_places():
    one, two = as_bodies(*walker(5, tall=2.0)), as_bodies(*walker(5, yaw=2.5, tall=-2.0), person=4)
    a, b = seen(one), seen(two)
    names = ("points", "confidence", "frame", "person")
    both = dataclasses.replace(a, **{n: torch.cat([getattr(x, n) for x in (a, b)]) for n in names})
    out = fit(both, SURE).bodies
    assert out.person.tolist() == [0] * 5 + [4] * 5
    assert out.pose.betas.unique(dim=0).shape[0] == 2
    assert (out.joints[:5, 0] - one.joints[:, 0]).norm(dim=-1).mean() < 0.4
    assert (out.joints[5:, 0] - two.joints[:, 0]).norm(dim=-1).mean() < 0.4


def test_rows_without_joints_are_left_out_and_nan_is_missing(walk):
    keypoints = seen(walk)
    points, sure = keypoints.points.clone(), keypoints.confidence.clone()
    points[2] = torch.nan
    points[5, 3] = torch.nan
    sure[7] = 0
    sure[8, 4] = torch.nan
    bad = dataclasses.replace(keypoints, points=points, confidence=sure)
    out = fit(bad, FEW)
    assert out.rows.tolist() == [0, 1, 3, 4, 5, 6, 8, 9, 10, 11]
    assert out.bodies.frame.tolist() == out.rows.tolist()
    assert out.bodies.size_spread == priors.UNKNOWN  # no height is given
    assert out.bodies.verts.isfinite().all()
    assert out.warnings == ("2 of 12 rows have fewer than 4 joints: left out",)


def test_keypoints_that_are_all_missing_are_refused(walk):
    nothing = dataclasses.replace(seen(walk), confidence=torch.zeros(12, 25))
    with pytest.raises(InputError, match=r"12 rows with at most 0 joints.*expected a row with 4"):
        fit(nothing)


@pytest.mark.slow
def test_a_person_in_one_frame_and_an_unordered_image_are_fitted(walk):
    for fps in (5.0, None):
        one = dataclasses.replace(
            seen(walk), points=seen(walk).points[3:4], confidence=torch.ones(1, 25),
            frame=torch.tensor([40]), person=torch.tensor([2]), fps=fps,
        )  # fmt: skip
        out = fit(one)
        assert out.bodies.frame.tolist() == [40]
        miss = out.bodies.joints[0, :22] - walk.joints[3, :22]
        assert (miss - miss[0]).norm(dim=-1).mean() < 0.08


@pytest.mark.slow
def test_a_known_floor_carries_people(walk, sharp):
    keypoints, plain = sharp
    floor = float((walk.verts @ CAMERA.R_cam_world[:, 1]).min()) + 0.2
    carried = fit(keypoints, ground=floor)
    depth = [
        (floor - f.bodies.joints @ CAMERA.R_cam_world[:, 1]).clamp_min(0).amax(1).mean()
        for f in (plain, carried)
    ]
    assert depth[1] < 0.5 * depth[0]


@pytest.mark.slow
def test_a_long_video_in_stretches_is_the_video_at_once(walk, sharp):
    keypoints, whole = sharp
    parts = fit(keypoints, dataclasses.replace(QUICK, chunk=10))
    assert parts.bodies.frame.tolist() == whole.bodies.frame.tolist()
    assert abs(off(parts, walk)[0] - off(whole, walk)[0]) < 0.02


def test_place_from_pixels_is_exact_under_the_true_camera():
    points = torch.randn(6, 9, 3, generator=torch.Generator().manual_seed(0))
    place = torch.tensor([0.4, -0.2, 5.0]).expand(6, 3)
    pixels = project(points + place[:, None], CAMERA.K)
    found = placed(points, pixels, torch.ones(6, 9), CAMERA.K)
    torch.testing.assert_close(found, place, atol=1e-3, rtol=0)
    blind = placed(points, pixels, torch.zeros(6, 9), CAMERA.K)
    assert (blind[:, 2] > 1).all()
    assert blind.isfinite().all()


def test_the_best_path_is_that_of_all_paths():
    rng = torch.Generator().manual_seed(0)
    cost, step = torch.rand(5, 3, generator=rng), torch.rand(4, 3, 3, generator=rng)
    paths = torch.cartesian_prod(*[torch.arange(3)] * 5)
    total = cost[torch.arange(5), paths].sum(1)
    total = total + torch.stack([step[k, paths[:, k], paths[:, k + 1]] for k in range(4)]).sum(0)
    assert best_path(cost, step).tolist() == paths[total.argmin()].tolist()


def test_constant_velocity_costs_nothing_over_gaps_and_long_gaps_join_nothing():
    frame = torch.tensor([0, 1, 3, 4, 40, 41, 42])
    motion = motion_of(keypoints_at(frame, 10.0), None, FitConfig())
    assert motion.near.triples.tolist() == [[0, 1, 2], [1, 2, 3], [4, 5, 6]]
    line = (0.3 * frame.float())[:, None, None].expand(-1, 2, 3)
    assert second_difference(line, motion.near).abs().max() < 1e-5
    assert len(motion_of(keypoints_at(frame, None), None, FitConfig()).expected) == 0
    speed = torch.tensor([0, 0, 5, 5, 5, 0, 5.0])[:, None].repeat(1, 22)
    speed[5, 20] = 5.0  # a wrist of a person at rest
    calm = motion_of(keypoints_at(frame, 10.0), speed, FitConfig())
    still = calm.calm < 0.2 * calm.expected[:, None]
    assert still.all(1).tolist() == [True, False, False]
    assert still.sum(1).tolist() == [22, 0, 21]
    torch.testing.assert_close(calm.calm[1], motion.calm[1])


def test_costs_are_those_of_the_publication():
    r = torch.tensor([0.0, 3.0, 100.0, 1e6])
    wanted = [0.0, 9e4 / 10009, 5000.0, 1e4]
    torch.testing.assert_close(robust_square(r**2, 100.0), torch.tensor(wanted), rtol=1e-4, atol=0)
    elbow = torch.zeros(2, 63)
    elbow[1, 52] = 0.7  # the left elbow, backwards: index 55 of the full pose less the root's three
    cost = priors.bent_wrong(elbow).exp().square().sum(-1)
    assert cost.tolist() == pytest.approx([4.0, 3 + np.exp(1.4)], rel=1e-5)
    assert PUBLISHED[0].pose == 4.78


def test_limits_mirror_left_and_right_and_hold_the_resting_pose():
    low, high, rest, _ = (row.reshape(21, 3) for row in priors.limit_table())
    for left, right in ((0, 1), (3, 4), (15, 16), (17, 18), (19, 20)):
        assert torch.equal(low[left, 0], low[right, 0])
        torch.testing.assert_close(low[left, 1:], -high[right, 1:])
    assert ((low < rest) & (rest < high)).all()
    pose = priors.resting(1, torch.zeros(1))
    assert float(priors.excess_of(pose).max()) == 0
    pose[0, 9] = np.radians(-9)  # the left knee forwards: 4 degrees beyond its limit
    assert float(priors.excess_of(pose).square().sum()) == pytest.approx(1, rel=1e-4)


def test_the_energy_has_the_gradient_of_finite_differences(walk):
    keypoints = dataclasses.replace(
        seen(walk), points=seen(walk).points[:3].double(), frame=torch.arange(3),
        confidence=torch.ones(3, 25).double(), person=torch.zeros(3, dtype=torch.long),
    )  # fmt: skip
    state = state_of(keypoints, walk.pose)
    looked = dataclasses.replace(state.seen, K=state.seen.K.double(), floor=-0.5)
    frame = dataclasses.replace(state.frame, root=state.frame.root.double())
    none = torch.zeros(3, 0).double()
    base = (
        0.1 * torch.ones(3, 3).double(),
        walk.pose.body_pose[:3].double() + 0.1,
        torch.tensor([[0.0, 0.02, 1.3]]).double().expand(3, 3).clone(),
        0.2 * torch.ones(1, 10).double(),
    )

    def total(*values):
        at = Unknowns(*values, none, none)
        return FitState(at, frame, looked, FitConfig()).energy(Stage()).total

    leaves = [v.clone().requires_grad_() for v in base]
    assert torch.autograd.gradcheck(total, leaves, eps=1e-6, rtol=1e-4, atol=1e-2, fast_mode=True)


def test_a_weight_of_zero_needs_no_evidence(walk):
    parts = state_of(seen(walk), walk.pose).energy(Stage(smooth=0.0)).parts
    assert set(parts) == {"keypoints", "pose", "limits", "bending", "shape"}
    assert all((value >= 0).all() for value in parts.values())


def test_frames_beyond_those_with_errors_of_their_own_do_not_constrain_the_shape(walk):
    person = (torch.arange(12) >= 8).long()  # eight rows of one, four of another
    config = FitConfig(independent_frames=6)
    state = state_of(seen(walk), walk.pose, torch.full((2, 10), 0.3), person, config)
    shape = state.energy(Stage(smooth=0.0)).parts["shape"] / (Stage().shape ** 2 * 0.9)
    torch.testing.assert_close(shape, torch.tensor([1 / 6] * 8 + [1 / 4] * 4))
    assert PAPER.independent_frames >= 100_000  # as published: all frames count


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smpl", "smplh", "smplx"])
def test_models_of_the_users_files_are_fitted_with_hands_and_face(name, tmp_path, monkeypatch):
    file = tmp_path / name / f"{name.upper()}_NEUTRAL.npz"
    model = load_smpl(name, place=write_npz(make_model(name), file))
    monkeypatch.setenv("MOVER_BODY_MODELS", str(tmp_path))
    walk = as_bodies(*walker(4))
    keypoints = seen(walk, layout="openpose137", noise=1.0)
    config = dataclasses.replace(QUICK, stages=(*QUICK.stages, Stage(4.78, 5, 4.78, 47.8, 1, 1)))
    out = fit(keypoints, config, model=model)
    assert out.bodies.verts.shape[1] == len(model.posed(out.bodies.pose)[0][0])
    miss = out.bodies.joints[:, :22] - walk.joints[:, :22]
    assert (miss - miss[:, :1]).norm(dim=-1).mean() < 0.08
    if name != "smpl":
        assert out.bodies.pose.extra["left_hand_pose"].shape == (4, 45)
    again = fit(keypoints, config, out.bodies, model)
    assert again.miss.mean() < 6


@pytest.mark.slow
def test_the_command_reads_openpose_and_writes_bodies(tmp_path, walk, capsys):
    from mover.app.cli.people import fit
    from mover.io.capture.bodies_file import read_bodies
    from mover.io.capture.camera_file import camera_to_json

    keypoints = seen(walk, noise=1.0)
    folder = tmp_path / "keypoints"
    folder.mkdir()
    for k in range(12):
        triple = torch.cat([keypoints.points[k], keypoints.confidence[k, :, None]], -1)
        person = {"pose_keypoints_2d": triple.reshape(-1).tolist()}
        (folder / f"{k:06d}_keypoints.json").write_text(json.dumps({"people": [person]}))
    (tmp_path / "camera.json").write_text(json.dumps(camera_to_json(CAMERA)))
    out = tmp_path / "bodies.npz"
    words = ["--out", str(out), "--fps", "5", "--drop"]
    fit([str(folder), "--camera", str(tmp_path / "camera.json"), *words])
    bodies = read_bodies(out)
    assert bodies.pose is not None
    assert bodies.fps == 5
    assert "keypoints missed by" in capsys.readouterr().out
    rows = bodies.frame
    assert (bodies.joints[:, 0] - walk.joints[rows, 0]).norm(dim=-1).median() < 0.3


def test_a_second_pass_takes_camera_and_floor_of_a_result(tmp_path):
    """One of camera and result, not both; a floor that is given counts before the result's."""
    from mover.app.cli.people import FitArgs, _world

    write_scene(Scene(CAMERA, -1.25, ()), tmp_path / "scene.json")
    camera, ground = _world(FitArgs(Path("k.npz"), room=tmp_path))
    torch.testing.assert_close(camera.R_cam_world, CAMERA.R_cam_world, atol=1e-5, rtol=0)
    torch.testing.assert_close(camera.K, CAMERA.K)
    assert ground == pytest.approx(-1.25)
    assert _world(FitArgs(Path("k.npz"), room=tmp_path, ground=-1.5))[1] == -1.5
    for both in ({}, {"room": tmp_path, "camera": tmp_path / "camera.json"}):
        with pytest.raises(InputError, match="--camera or --room"):
            _world(FitArgs(Path("k.npz"), **both))


def test_the_preset_paper_weighs_motion_as_printed(walk):
    """L_smooth of a track at even times, by a loop over Sec. 3.2, with the released weights."""
    keypoints = dataclasses.replace(seen(walk), fps=30.0, confidence=torch.ones(12, 25))
    state = state_of(keypoints, walk.pose, config=PAPER)
    parts = state.energy(PAPER.stages[0]).parts

    def rho(squared, sigma):
        return sigma**2 * squared / (squared + sigma**2)

    joints, pixels = state.points.joints[:, :22], state.pixels
    weight, wanted = state.seen.weight, [0.0, 0.0]
    for t in range(1, 11):
        second = joints[t - 1] + joints[t + 1] - 2 * joints[t]
        wanted[0] += 1e2 * float(sum(rho(float(j.square().sum()), 0.1) for j in second))
        second = (pixels[t - 1] + pixels[t + 1] - 2 * pixels[t]).square().sum(-1)
        wanted[1] += 1e-2 * float((weight[t].square() * rho(second, 100.0)).sum())
    assert float(parts["smooth_joints"].sum()) == pytest.approx(wanted[0], rel=1e-4)
    assert float(parts["smooth_pixels"].sum()) == pytest.approx(wanted[1], rel=1e-4)
    assert [s.pose for s in PAPER.stages] == [4.78, 4.78]


def test_heights_are_given_one_by_one_or_for_all():
    everybody = torch.tensor([4, 7, 4, 9])
    one = priors.stature_of(open_body(), (1.7,), everybody, torch.arange(4))
    assert one.given.tolist() == pytest.approx([1.7, 1.7, 1.7])
    some = priors.stature_of(open_body(), (1.6, 1.7, 1.8), everybody, torch.tensor([0, 2, 3]))
    assert some.given.tolist() == pytest.approx([1.6, 1.8])  # nothing is seen of number 7
    assert priors.stature_of(open_body(), (), everybody, torch.arange(4)).given.isnan().all()
    with pytest.raises(InputError, match="height: 2 are given, expected 1, or 3: one a person"):
        priors.stature_of(open_body(), (1.7, 1.8), everybody, torch.arange(4))


def test_the_height_of_numbers_of_the_shape_is_that_of_the_body():
    betas = torch.tensor([[1.5, -1.0, 0.5], [0.0, 2.0, 0.0]])
    y = shaped(open_body(), betas)[0][..., 1]
    tall = y.amax(-1) - y.amin(-1)
    two = torch.arange(2)
    known = priors.stature_of(open_body(), tuple((tall + 0.02).tolist()), two, two)
    cost = priors.height_cost(known, betas)
    torch.testing.assert_close(cost, torch.full((2,), 4e-4), atol=1e-4, rtol=0.2)


@pytest.mark.slow
def test_people_of_known_height_are_where_they_are(walk):
    tall = float(np.ptp(shaped(open_body(), walk.pose.betas[:1])[0][0, :, 1].numpy()))
    keypoints = seen(walk, noise=3.0)
    right, tenth = (fit(keypoints, SURE, heights=(share * tall,)) for share in (1.0, 1.1))
    assert right.bodies.size_spread == 0.0  # fitted bodies still: the floor under them may lean
    (_, near), (_, wrong) = (off(one, walk) for one in (right, tenth))
    assert near < 0.1
    assert wrong > 0.3  # a tenth taller is a tenth farther away


def test_larger_bodies_do_not_move_less_smoothly(walk):
    state = state_of(seen(walk, noise=3.0), walk.pose)
    costs: list[torch.Tensor] = []
    for joints in (walk.joints, 1.1 * walk.joints):
        points = dataclasses.replace(state.points, joints=joints)
        larger = dataclasses.replace(state)
        larger.__dict__["points"] = points
        costs.append(TERM["smooth_joints"](larger).sum())
    torch.testing.assert_close(priors.size_of(1.1 * walk.joints), 1.1 * priors.size_of(walk.joints))
    torch.testing.assert_close(*costs)
    assert costs[0] > 0
