"""Files for humanoid tools, read as their own public readers read them: names, shapes, guesses."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from furnished import bodies_of, furnished, moving_pose, two_people, write_out
from little_room import GROUND, walkers
from make_smpl import make_model, write_npz

from mover.app.cli import run_command
from mover.bodies import load_model
from mover.bodies.skeleton import BODY
from mover.core.errors import InputError
from mover.core.types import Bodies, BodyPose
from mover.geometry.placement import place_object
from mover.io.export.finished import Finished, read_finished
from mover.io.export.humanoid import MOCAP, export_amass, export_gmr, export_holosoma


def finished(tmp_path: Path, bodies: Bodies | None) -> Finished:
    return read_finished(write_out(tmp_path / "out", furnished(("table",)), bodies))


def upright(points: torch.Tensor) -> np.ndarray:
    x, y, z = points.double().unbind(-1)
    return torch.stack([x, -z, y - GROUND], -1).numpy()


def at_thirty(bodies: Bodies, places: torch.Tensor) -> np.ndarray:
    """Values of one person between its frames, 30 a second: a naive loop."""
    times = (bodies.frame - bodies.frame.min()).double() / bodies.fps
    steps = int(float(times[-1]) * 30 + 1e-6) + 1
    rows = []
    for k in range(steps):
        after = min(int((times < k / 30 - 1e-9).sum()), len(times) - 1)
        before = max(after - 1, 0)
        gap = float(times[after] - times[before])
        share = 1.0 if gap == 0 else (k / 30 - float(times[before])) / gap
        rows.append((1 - share) * places[before] + share * places[after])
    return np.stack(rows)


def test_holosoma_finds_its_joints_and_the_height(tmp_path: Path):
    """amazon-far/holosoma: robot_retarget.py, load_motion_data (`smplx`), SMPLX_DEMO_JOINTS."""
    bodies = bodies_of(moving_pose(8))
    file = export_holosoma(finished(tmp_path, bodies), tmp_path).files[0]
    human_data = np.load(tmp_path / "holosoma" / "person_0.npz")
    assert file.name == "person_0.npz"
    joints, height = human_data["global_joint_positions"], human_data["height"]
    assert height.shape == ()
    assert 1.5 < float(height) < 2.0
    truth = at_thirty(bodies, torch.from_numpy(upright(bodies.joints[:, :22])))
    assert joints.shape == truth.shape
    assert joints == pytest.approx(truth, abs=1e-4)
    assert bodies.joint_names[:22] == BODY
    scale = 1.32 / height  # what the reader does with it
    assert np.isfinite(joints * scale).all()


def test_holosoma_climbs_over_one_convex_piece_a_geom(tmp_path: Path):
    """src/utils.py rewrites every `scale="..."`; box_assets.xml goes into the robot's scene."""
    home = finished(tmp_path, bodies_of(moving_pose(8)))
    export_holosoma(home, tmp_path)
    clip = tmp_path / "holosoma" / "person_0"
    (motion,) = clip.glob("*.npy")
    joints = np.load(motion)
    assert joints.shape[1:] == (53, 3) == (len(MOCAP), 3)
    downsampled = joints[::4]
    smplx = np.load(tmp_path / "holosoma" / "person_0.npz")["global_joint_positions"]
    assert downsampled[:, 0] == pytest.approx(smplx[:, 0], abs=1e-5)
    assert MOCAP[43:51] == (
        "left_hip", "left_knee", "left_ankle", "left_foot",
        "right_hip", "right_knee", "right_ankle", "right_foot",
    )  # fmt: skip
    assert MOCAP[8] == "left_wrist"
    assert MOCAP[15] == "left_middle1"
    whole = trimesh.load(clip / "multi_boxes.obj", force="mesh")
    (table,) = home.scene.objects
    truth = upright(place_object(table).verts)
    assert whole.bounds == pytest.approx(np.stack([truth.min(0), truth.max(0)]), abs=2e-3)
    boxes = sorted((clip / "box_models").glob("box*.obj"))
    assert len(boxes) > 1
    shapes = [trimesh.load(box, force="mesh") for box in boxes]
    assert [s.volume for s in shapes] == pytest.approx([s.convex_hull.volume for s in shapes])
    for name in ("multi_boxes.urdf", "box_assets.xml"):
        found = re.findall(r'scale="[^"]*"', (clip / name).read_text())
        assert found == ['scale="1 1 1"'] * len(boxes) * (2 if name.endswith("urdf") else 1)


def test_mujoco_reads_the_climb_scaled_as_holosoma_scales_it(tmp_path: Path):
    mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")
    home = finished(tmp_path, bodies_of(moving_pose(4)))
    export_holosoma(home, tmp_path)
    clip = tmp_path / "holosoma" / "person_0"
    assets = re.sub(r'scale="[^"]*"', 'scale="0.7 0.7 0.7"', (clip / "box_assets.xml").read_text())
    (clip / "box_assets_scaled.xml").write_text(assets)
    scene = (
        '<mujoco><asset><include file="box_assets_scaled.xml"/></asset><worldbody>'
        '<geom name="ground" type="plane" size="5 5 1"/><include file="box_body.xml"/>'
        "</worldbody></mujoco>"
    )
    (clip / "scene.xml").write_text(scene)
    model = mujoco.MjModel.from_xml_path(str(clip / "scene.xml"))
    assert model.ngeom == 1 + len(list((clip / "box_models").iterdir()))
    assert mujoco.MjModel.from_xml_path(str(clip / "multi_boxes.urdf")).nv == 0


SMPLX_KEYS = {"gender", "mocap_frame_rate", "trans", "root_orient", "pose_body", "betas"}
AMASS_KEYS = {
    *SMPLX_KEYS, "surface_model_type", "mocap_time_length", "poses", "num_betas", "pose_hand",
    "pose_jaw", "pose_eye",
}  # fmt: skip


@pytest.fixture
def smplx(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bodies:
    """People of a made-up SMPL-X file, walking."""
    file = tmp_path / "models" / "smplx" / "SMPLX_NEUTRAL.npz"
    file.parent.mkdir(parents=True)
    write_npz(make_model("smplx"), file)
    monkeypatch.setenv("MOVER_BODY_MODELS", str(tmp_path / "models"))
    base, model = moving_pose(8), load_model("smplx")
    betas = torch.zeros(8, 10)
    betas[:, 0] = 0.7
    pose = BodyPose(
        "smplx", "neutral", betas, base.global_orient, base.body_pose, base.transl, {}
    )  # fmt: skip
    verts, joints = model.posed(pose)
    return dataclasses.replace(
        bodies_of(base), verts=verts, faces=model.faces, joints=joints[:, :55],
        joint_names=tuple(model.joint_names[:55]), pose=pose,
    )  # fmt: skip


@pytest.mark.parametrize("write", [export_gmr, export_amass])
def test_smplx_poses_what_is_written_to_the_result_turned_upright(
    write, smplx: Bodies, tmp_path: Path
):
    """YanjieZe/GMR: utils/smpl.py, load_smplx_file; AMASS' keys as holosoma's prep_amass lists."""
    found = write(finished(tmp_path, smplx), tmp_path)
    data = np.load(found.files[0], allow_pickle=True)
    assert set(data.files) == (SMPLX_KEYS if write is export_gmr else AMASS_KEYS)
    frames = data["pose_body"].shape[0]
    pose = BodyPose(
        "smplx", str(data["gender"]),
        torch.tensor(data["betas"]).float().view(1, -1)[:, :10].expand(frames, -1),
        torch.tensor(data["root_orient"]).float(), torch.tensor(data["pose_body"]).float(),
        torch.tensor(data["trans"]).float(), {},
    )  # fmt: skip
    assert data["mocap_frame_rate"].item() == 30.0
    _, joints = load_model("smplx").posed(pose)
    rate = int(30 / (smplx.fps / 2))  # every second frame of the video is known
    truth = upright(smplx.joints[:, :22])
    assert joints[::rate, :22].numpy() == pytest.approx(truth, abs=2e-4)
    assert "not SMPL-X" not in " ".join(found.notes)


def test_amass_files_hold_what_their_readers_slice(smplx: Bodies, tmp_path: Path):
    data = np.load(export_amass(finished(tmp_path, smplx), tmp_path).files[0])
    frames = len(data["trans"])
    assert int(data["num_betas"]) == data["betas"].shape[0] == 16
    assert data["poses"].shape == (frames, 165)
    assert data["pose_hand"].shape == (frames, 90)
    assert np.array_equal(data["poses"][:, :3], data["root_orient"])
    assert np.array_equal(data["poses"][:, 3:66], data["pose_body"])
    assert float(data["mocap_time_length"]) == pytest.approx(frames / 30)


def test_other_bodies_keep_angles_pelvis_and_height_and_it_is_said(tmp_path: Path):
    bodies = bodies_of(moving_pose(6))
    found = export_gmr(finished(tmp_path, bodies), tmp_path)
    data = np.load(found.files[0])
    assert "not SMPL-X" in " ".join(found.notes)
    pelvis = data["trans"] + [0.003, -0.351, 0.012]
    assert pelvis[::6] == pytest.approx(upright(bodies.joints[:, 0]), abs=1e-4)
    assert data["pose_body"][::6] == pytest.approx(bodies.pose.body_pose.numpy(), abs=1e-4)
    export_holosoma(finished(tmp_path, bodies), tmp_path)
    height = np.load(tmp_path / "holosoma" / "person_0.npz")["height"]
    assert 1.66 + 0.1 * data["betas"][0] == pytest.approx(float(height), abs=1e-4)  # GMR's formula


def test_each_span_in_which_somebody_is_seen_is_a_clip(tmp_path: Path):
    bodies = two_people(6)
    found = export_gmr(finished(tmp_path, bodies), tmp_path)
    assert [f.stem for f in found.files] == ["person_0", "person_1_0", "person_1_1"]
    lengths = [len(np.load(f)["trans"]) for f in found.files]
    assert lengths == [31, 13, 13]  # 1 s; 0.4 s twice


def test_bodies_without_joints_or_parameters_are_refused(tmp_path: Path):
    home = finished(tmp_path, walkers(3))
    with pytest.raises(InputError, match="--to holosoma: the result's bodies have no joints"):
        export_holosoma(home, tmp_path)
    with pytest.raises(InputError, match=r"--to gmr: bodies\.npz has no parameters"):
        export_gmr(home, tmp_path)
    with pytest.raises(InputError, match="--to amass: the result has no bodies"):
        export_amass(finished(tmp_path / "b", None), tmp_path)


def test_the_command_writes_all_of_them(tmp_path: Path, capsys):
    out = write_out(tmp_path / "out", furnished(("table",)), bodies_of(moving_pose(3)))
    assert run_command("export", [str(out), "--to", "gmr", "amass", "holosoma"]) == 0
    names = {p.name for p in (out / "export").rglob("*") if p.is_file()}
    assert {"person_0_stageii.npz", "person_0.npz", "person_0.npy", "multi_boxes.urdf"} <= names
    assert "30 frames a second" in capsys.readouterr().out
