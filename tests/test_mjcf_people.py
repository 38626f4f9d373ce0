"""People in MuJoCo: mocap skeletons, moved by keyframes, beside furniture that stays."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from furnished import bodies_of, furnished, moving_pose, similar, two_people, write_out
from little_room import GROUND, walkers

from mover.core.types import Bodies, Segment
from mover.geometry.placement import placed_at
from mover.io.export.finished import Finished, read_finished
from mover.io.export.mjcf import export_mjcf

mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")


def model_of(tmp_path: Path, bodies: Bodies | None, **options: Any) -> Any:
    home = read_finished(write_out(tmp_path / "out", furnished(("table",)), bodies))
    return mujoco.MjModel.from_xml_path(str(export_mjcf(home, tmp_path, **options).files[0]))


def upright(points: torch.Tensor) -> np.ndarray:
    x, y, z = points.double().unbind(-1)
    return torch.stack([x, -z, y - GROUND], -1).numpy()


def test_every_keyframe_puts_every_joint_where_it_was(tmp_path: Path):
    bodies = two_people(5)
    model = model_of(tmp_path, bodies)
    data = mujoco.MjData(model)
    frames = bodies.frame.unique().tolist()
    assert model.nkey == len(frames)
    assert model.nmocap == 2 * (22 + 30)  # with hands, as one of them moves
    for key, frame in enumerate(frames):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_forward(model, data)
        assert model.key(key).name == f"frame_{frame}"
        assert data.time == pytest.approx((frame - frames[0]) / bodies.fps, abs=1e-5)
        for person in (0, 1):
            seen = ((bodies.frame == frame) & (bodies.person == person)).nonzero()[:, 0].tolist()
            pelvis = data.body(f"person_{person}_pelvis").xpos
            assert (pelvis[2] > -1) == bool(seen)
            for row in seen:
                for joint in (0, 5, 15, 21, 30, 50):
                    name = f"person_{person}_{bodies.joint_names[joint]}"
                    truth = upright(bodies.joints[row, joint])
                    assert data.body(name).xpos == pytest.approx(truth, abs=2e-4), name


def test_bones_end_at_the_next_joint_and_so_turns_are_right(tmp_path: Path):
    bodies = bodies_of(moving_pose(4))
    model = model_of(tmp_path, bodies)
    data = mujoco.MjData(model)
    pairs = (("left_hip", "left_knee"), ("left_elbow", "left_wrist"), ("pelvis", "spine1"))
    for key in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_forward(model, data)
        for one, other in pairs:
            body, goal = model.body(f"person_0_{one}"), data.body(f"person_0_{other}").xpos
            geoms = range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
            ends = []
            for geom in geoms:
                axis = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom][1]
                ends += [data.geom_xpos[geom] + axis, data.geom_xpos[geom] - axis]
            assert min(np.linalg.norm(end - goal) for end in ends) < 0.001, (one, other)


def test_people_push_nothing(tmp_path: Path):
    model = model_of(tmp_path, two_people(4))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    start = np.array(data.body("table_0").xpos)
    data.mocap_pos[:] = start + np.array([0, 0, 0.3])
    for _ in range(1000):  # two seconds
        mujoco.mj_step(model, data)
    assert np.linalg.norm(data.body("table_0").xpos - start) < 0.001


def test_people_who_grew_with_the_room_are_as_large_as_in_the_result(tmp_path: Path):
    truth = two_people(4)
    grown, _ = similar(truth, 1.05)
    out = write_out(tmp_path / "out", furnished(("table",)))
    home = Finished(out, read_finished(out).scene, grown, truth)
    path = export_mjcf(home, tmp_path).files[0]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 1)
    mujoco.mj_forward(model, data)
    row = int(((grown.frame == grown.frame.unique()[1]) & (grown.person == 0)).nonzero()[0, 0])
    for joint in (0, 7, 21):
        name = f"person_0_{truth.joint_names[joint]}"
        assert data.body(name).xpos == pytest.approx(upright(grown.joints[row, joint]), abs=1e-3)


def test_bodies_without_joints_are_left_out_and_it_is_said(tmp_path: Path):
    home = read_finished(write_out(tmp_path / "out", furnished(("table",)), walkers(3)))
    found = export_mjcf(home, tmp_path)
    assert "no people" in " ".join(found.notes)
    assert mujoco.MjModel.from_xml_path(str(found.files[0])).nmocap == 0
    assert model_of(tmp_path / "b", two_people(3), body="none").nmocap == 0


@pytest.mark.parametrize("count", [0, 3])
def test_keyframes_put_furniture_where_it_then_stands(tmp_path: Path, count: int):
    home = read_finished(write_out(tmp_path / "out", furnished(("table", "chair")), None))
    chair = home.scene.objects[1]
    later = Segment(8, chair.t_world_object + torch.tensor([0.3, 0.0, 1.0]), chair.yaw + 1)
    moved = dataclasses.replace(
        chair, segments=(Segment(0, chair.t_world_object, chair.yaw), later)
    )
    scene = dataclasses.replace(home.scene, objects=(home.scene.objects[0], moved))
    bodies = two_people(count) if count else None
    file = export_mjcf(dataclasses.replace(home, scene=scene, bodies=bodies), tmp_path).files[0]
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    frames = [int(model.key(k).name.removeprefix("frame_")) for k in range(model.nkey)]
    assert 8 in frames
    assert min(frames) < 8
    for key, frame in enumerate(frames):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_forward(model, data)
        for piece in scene.objects:
            there = placed_at(piece, frame)
            assert data.body(piece.id).xpos == pytest.approx(upright(there.t_world_object))
            front = data.body(piece.id).xmat.reshape(3, 3) @ [0, -1, 0]
            yaw = float(there.yaw)
            assert front == pytest.approx([np.sin(yaw), -np.cos(yaw), 0], abs=1e-6)
