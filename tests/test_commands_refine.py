"""`mover refine` and `mover contacts` from the command line; a licensed model's bodies refined."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts
from figures import ARMS_DOWN, people, pose
from little_room import camera
from make_keypoints import rest_pose
from make_smpl import make_model, write_npz
from test_pipeline import light

from mover.app import cli
from mover.bodies.skinning import open_body
from mover.bodies.smpl_files import load_smpl
from mover.core import records
from mover.core.types import Bodies, Mesh, Scene, SceneObject
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.capture.scene_file import write_scene
from mover.io.files.fields import write_json
from mover.io.files.meshes import write_mesh

GROUND = -1.4
FAR = 0.06  # share by which somebody seems too far away: they then sink into the floor


def standing(far: float, frames: int = 3, name: str = "makehuman") -> Bodies:
    """Somebody who stands still three metres away, seen in the right pixels but too far."""
    if name == "makehuman":
        model, base = open_body(), pose(ARMS_DOWN, frames)
    else:
        model = load_smpl(name)
        base = rest_pose(frames, model)
    verts, joints = model.posed(base)
    low, middle = verts[0, :, 1].min(), verts[0].mean(0)
    shift = torch.stack([-middle[0], GROUND - low, -3.0 - middle[2]])
    base = replace(base, transl=base.transl + shift + far * (joints[:, 0] + shift))
    verts, joints = model.posed(base)
    bodies = people(pose(ARMS_DOWN, frames), 5.0)
    return replace(
        bodies, verts=verts, faces=model.faces, joints=joints, joint_names=model.joint_names,
        pose=base,
    )  # fmt: skip


def finished(out: Path, bodies: Bodies | None) -> Path:
    """A result: a box on a floor, and people."""
    mesh = Mesh(box_verts((0.5, 0.5, 0.5)).float(), FACES)
    box = SceneObject(
        "box_0", "stool", mesh, "", None, "ground", torch.tensor([1.0, GROUND, -3.0]),
        torch.tensor(0.0), torch.ones(3),
    )  # fmt: skip
    write_scene(Scene(camera(pitch=0.0), GROUND, (box,)), out / "scene.json")
    (out / "watertight").mkdir(exist_ok=True)
    write_mesh(mesh, out / "watertight" / "box_0.glb")
    if bodies is not None:
        write_bodies(bodies, out / "bodies.npz")
    return out


def lowest(bodies: Bodies) -> torch.Tensor:
    return bodies.verts[..., 1].amin(1) - GROUND


@pytest.mark.slow
def test_refine_lifts_people_out_of_the_floor_and_says_how_wrong_they_were(tmp_path, capsys):
    out = finished(tmp_path / "out", standing(FAR))
    truth = finished(tmp_path / "truth", standing(0.0))
    before = (out / "bodies.npz").read_bytes()
    assert cli.run_command("refine", [str(out), "--truth", str(truth), "--rounds", "2"]) == 0
    assert (out / "bodies.npz").read_bytes() == before
    found = read_bodies(out / "refined" / "bodies.npz")
    assert lowest(found).abs().max() < 0.5 * lowest(read_bodies(out / "bodies.npz")).abs().min()
    values = json.loads((out / "refined" / "metrics.json").read_text())
    assert values["result"]["pje"] > 0.15
    assert values["refined"]["pje"] < 0.75 * values["result"]["pje"]
    assert "3 bodies refined with their pose" in capsys.readouterr().out


@pytest.mark.slow
def test_without_the_floor_no_one_is_lifted(tmp_path):
    out = finished(tmp_path / "out", standing(FAR))
    assert cli.run_command("refine", [str(out), "--without", "camgp", "--rounds", "1"]) == 0
    assert lowest(read_bodies(out / "refined" / "bodies.npz")).max() < -0.02


def test_a_result_without_people_is_refused_and_nothing_is_written(tmp_path, capsys):
    out = finished(tmp_path / "out", None)
    assert cli.run_command("refine", [str(out)]) != 0
    assert "no people to refine" in capsys.readouterr().err
    assert not (out / "refined").exists()


@pytest.mark.slow
def test_bodies_of_a_licensed_model_are_refined_with_their_parameters(tmp_path, monkeypatch):
    write_npz(make_model("smplx"), tmp_path / "models" / "smplx" / "SMPLX_NEUTRAL.npz")
    monkeypatch.setenv("MOVER_BODY_MODELS", str(tmp_path / "models"))
    out = finished(tmp_path / "out", standing(FAR, 2, "smplx"))
    assert cli.run_command("refine", [str(out), "--rounds", "1"]) == 0
    found = read_bodies(out / "refined" / "bodies.npz")
    assert found.pose.model == "smplx"
    assert lowest(found).abs().max() < 0.025
    again, _ = load_smpl("smplx").posed(found.pose)
    torch.testing.assert_close(again, found.verts, atol=1e-4, rtol=0)


def test_contacts_of_another_tool_become_contacts_npz(tmp_path, capsys):
    bodies = standing(0.0)
    write_bodies(bodies, tmp_path / "bodies.npz")
    chance = np.zeros(bodies.verts.shape[:2], np.float32)
    chance[1, :40] = 0.9
    np.save(tmp_path / "deco.npy", chance)
    out, words = tmp_path / "contacts.npz", ["files", str(tmp_path / "bodies.npz")]
    assert cli.run_command("contacts", words) != 0
    assert "--source: is missing, expected a path" in capsys.readouterr().err
    words += ["--source", str(tmp_path / "deco.npy"), "--out", str(out)]
    assert cli.run_command("contacts", words) == 0
    np.testing.assert_array_equal(np.load(out)["probability"], chance)
    assert "1 of 3 bodies touch something" in capsys.readouterr().out


@pytest.mark.slow
def test_a_run_ends_with_the_people_that_refine_would_give(tmp_path, small_capture, capsys):
    """The room is the same, and its people are those of `mover refine` on the plain result."""
    from mover.io.capture.folder import write_capture

    write_capture(small_capture, tmp_path / "capture")
    write_json({"config": records.plain(light("robust"))}, tmp_path / "config.json")
    out = tmp_path / "out"
    run = [str(tmp_path / "capture"), "--out", str(out), "--config", str(tmp_path / "config.json")]
    assert cli.run_command("run", run) == 0
    scene, given = (out / "scene.json").read_bytes(), read_bodies(out / "bodies.npz")
    assert cli.run_command("refine", [str(out)]) == 0
    (tmp_path / "capture").rename(tmp_path / "same")  # what a folder had before is not lost unsaid
    again = [str(tmp_path / "same"), *run[1:], "--refine"]
    assert "which is replaced" not in capsys.readouterr().out
    assert cli.run_command("run", again) == 0
    assert f"has the result of {run[0]}, which is replaced" in capsys.readouterr().out
    found, wanted = (read_bodies(out / name) for name in ("bodies.npz", "refined/bodies.npz"))
    torch.testing.assert_close(found.verts, wanted.verts, atol=2e-3, rtol=0)
    assert (found.verts - given.verts).norm(dim=-1).median() > 0.01
    assert (out / "scene.json").read_bytes() == scene
    assert json.loads((out / "run.json").read_text())["people_refined"]
