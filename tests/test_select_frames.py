"""The frame filter: wrong frames go, honest motion stays."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mover.core.types import Bodies
from mover.stages.config import SelectConfig
from mover.stages.people.select_frames import LOCAL, select_frames

SHARED = Path(__file__).parents[2] / "shared"


def bodies_of(joints, frame, fps: float | None = 30.0, person=None, names=("pelvis", *LOCAL)):
    joints = torch.as_tensor(np.asarray(joints), dtype=torch.float32)
    n = len(joints)
    return Bodies(
        joints[:, :3], torch.tensor([[0, 1, 2]]), joints if names else None, names,
        torch.as_tensor(frame), torch.as_tensor(np.zeros(n, int) if person is None else person),
        fps, "camera", None,
    )  # fmt: skip


def kept(bodies, **config):
    return select_frames(bodies, SelectConfig(**config)).keep.numpy()


def walk_and_sit(seconds=8.0, fps=30.0, seed=0):
    """Walk at 1.3 m/s with swinging limbs, turn, walk back and drop onto a seat; 1 cm of jitter."""
    t = np.arange(int(seconds * fps)) / fps
    x = 1.3 * np.where(t < 3, t, np.clip(6.4 - t, 2.4, 3))
    y = 0.02 * np.sin(4 * np.pi * t) + 0.45 / (1 + np.exp(-8 * (t - 6.5)))
    pelvis = np.stack([x, y, np.full_like(t, 3.0)], -1)
    away = np.random.default_rng(1).normal(size=(8, 3)) * [0.2, 0.4, 0.1]
    swing = 0.25 * np.sin(2 * np.pi * t)[:, None] * np.array([0.2, -0.2, 1, -1, 0, 0, 1, -1])
    local = pelvis[:, None] + away + swing[..., None] * [1, 0, 0]
    joints = np.concatenate([pelvis[:, None], local], 1)
    return joints + np.random.default_rng(seed).normal(0, 0.01, joints.shape)


@pytest.mark.parametrize("fps", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("seed", range(3))
def test_exactly_the_frames_that_jump_by_half_a_metre_are_left_out(fps, seed):
    joints = walk_and_sit(fps=fps, seed=seed)
    wrong = np.random.default_rng(seed).choice(len(joints) // 4, 3, replace=False) * 4
    direction = np.random.default_rng(seed + 9).normal(size=(3, 3))
    joints[wrong] += 0.5 * (direction / np.linalg.norm(direction, axis=1, keepdims=True))[:, None]
    expected = np.ones(len(joints), bool)
    expected[wrong] = False
    assert (kept(bodies_of(joints, np.arange(len(joints)), fps)) == expected).all()


@pytest.mark.parametrize("fps", [5.0, 30.0])
def test_a_body_that_is_turned_for_one_frame_is_left_out(fps):
    joints = walk_and_sit(fps=fps)
    swapped = [0, 2, 1, 4, 3, 6, 5, 8, 7]
    wide = joints + np.array([0, 1, -1, 1, -1, 1, -1, 1, -1])[:, None] * [0.25, 0, 0]
    wide[20] = wide[20][swapped]
    assert np.flatnonzero(~kept(bodies_of(wide, np.arange(len(wide)), fps))).tolist() == [20]


@pytest.mark.parametrize("fps", [5.0, 10.0, 30.0])
def test_honest_walking_and_sitting_down_are_kept_whole(fps):
    for seed in range(5):
        joints = walk_and_sit(fps=fps, seed=seed)
        for rule in ("chain", "each"):
            assert kept(bodies_of(joints, np.arange(len(joints)), fps), rule=rule).all()


def test_several_wrong_frames_in_a_row_are_left_out_and_their_neighbours_kept():
    joints = walk_and_sit()
    joints[50:53] += [0, 0, 0.6]
    assert np.flatnonzero(~kept(bodies_of(joints, np.arange(len(joints))))).tolist() == [50, 51, 52]


def test_a_track_that_jumps_to_another_place_for_good_keeps_both_parts():
    joints = walk_and_sit()
    joints[100:] += [3, 0, 0]
    assert kept(bodies_of(joints, np.arange(len(joints)))).mean() > 0.98


def test_gaps_in_time_are_no_accelerations():
    joints, frame = walk_and_sit(), np.arange(240)
    there = (frame < 40) | (frame > 75) & (frame % 7 != 3)
    for rule in ("chain", "each"):
        assert kept(bodies_of(joints[there], frame[there]), rule=rule).all()
        assert not kept(bodies_of(joints[there], np.arange(there.sum())), rule="each").all()


def test_tracks_and_the_order_of_rows_do_not_touch_each_other():
    joints, other = walk_and_sit(), walk_and_sit(seed=3)
    other[..., 2] += 2
    other[30] += [0.5, 0, 0]
    both, frame = np.concatenate([joints, other]), np.tile(np.arange(240), 2)
    person, order = np.repeat([7, 2], 240), np.random.default_rng(0).permutation(480)
    keep = kept(bodies_of(both[order], frame[order], person=person[order]))
    assert order[~keep].tolist() == [270]


def test_unordered_images_and_short_tracks_are_kept():
    joints = np.random.default_rng(0).normal(size=(6, 9, 3)) * 3
    assert kept(bodies_of(joints, np.arange(6), fps=None)).all()
    assert kept(bodies_of(joints[:2], np.arange(2))).all()


def test_bodies_without_joints_are_judged_by_their_vertices():
    joints = walk_and_sit()
    joints[60] += [0.5, 0, 0]
    bodies = bodies_of(joints, np.arange(240), names=())
    assert np.flatnonzero(~kept(bodies)).tolist() == [60]


def test_the_rule_of_the_paper_equals_a_naive_loop(monkeypatch):
    joints = walk_and_sit(seed=4)
    limits = {"PELVIS_ACCELERATION": 3.0, "PELVIS_JITTER": 0.06, "LOCAL_JITTER": 0.07}
    for name, value in (limits | {"LOCAL_ACCELERATION": 0.0}).items():
        monkeypatch.setattr(f"mover.stages.people.select_frames.{name}", value)
    keep = kept(bodies_of(joints, np.arange(240)), rule="each")
    wrong = np.zeros(240, bool)
    for t in range(1, 239):
        second = joints[t + 1] - 2 * joints[t] + joints[t - 1]
        relative = [second[k] - second[0] for k in range(1, 9)]
        alpha = np.mean([np.linalg.norm(r) for r in relative])
        wrong[t] = np.linalg.norm(second[0]) >= 0.06 + 3 / 900 or alpha >= 0.07
    assert 0.1 < keep.mean() < 0.9
    assert keep.tolist() == (~wrong).tolist()


@pytest.mark.skipif(not (SHARED / "data/cmu").exists(), reason="no motion capture here")
@pytest.mark.parametrize("every", [4, 12, 24])
def test_real_people_who_climb_and_sit_are_kept(every):
    hips = []
    for line in (SHARED / "data/cmu/01_08.amc").read_text().splitlines():
        if line.startswith("root"):
            hips.append([float(v) for v in line.split()[1:4]])
    pelvis = np.array(hips)[::every] * 2.54 / 45
    joints = np.repeat(pelvis[:, None], 9, 1)
    assert kept(bodies_of(joints, np.arange(len(joints)), 120 / every)).all()
