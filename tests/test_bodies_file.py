from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
import torch

from mover.bodies import load_model
from mover.bodies.skinning import open_body, zero_pose
from mover.core.errors import InputError
from mover.core.types import BodyPose
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.capture.folder import read_capture
from mover.io.capture.pose_file import into_camera
from mover.stages.people.find_depth import size_spread

ROWS = 3


def parameters() -> dict[str, Any]:
    generator = np.random.default_rng(3)
    return {
        "model": np.array("makehuman"), "gender": np.array("neutral"),
        "betas": np.zeros(zero_pose(1, open_body()).betas.shape[1]),
        "global_orient": generator.normal(size=(ROWS, 3)),
        "body_pose": generator.normal(size=(ROWS, 63)) * 0.2,
        "transl": generator.normal(size=(ROWS, 3)) * 0.3 + [0, 0, 4],
        "left_hand_pose": generator.normal(size=(ROWS, 45)) * 0.1,
    }  # fmt: skip


def rows() -> dict[str, Any]:
    return {k: v for k, v in tiny.bodies().items() if k in ("frame", "person", "space")}


def pose() -> BodyPose:
    data = {k: torch.from_numpy(v).float() for k, v in parameters().items() if v.dtype.kind == "f"}
    hand = {"left_hand_pose": data.pop("left_hand_pose")}
    data["betas"] = data["betas"].expand(ROWS, -1)
    return BodyPose("makehuman", "neutral", **data, extra=hand)


def save(path: Path, **arrays: Any) -> Path:
    np.savez(path / "bodies.npz", **arrays)
    return path / "bodies.npz"


def read(path: Path) -> tuple[Any, str]:
    warnings: list[str] = []
    return read_bodies(path, warnings.append), "\n".join(warnings)


MODEL = load_model("makehuman")


def meshes_of(shift: float = 0.0) -> dict[str, np.ndarray]:
    """The parameters' meshes."""
    verts = MODEL.posed(pose())[0].numpy() + np.float32(shift)
    return {"vertices": verts, "faces": MODEL.faces.numpy()}


def test_parameters_alone_are_posed_also_in_a_capture(tmp_path, folder):
    found, words = read(save(tmp_path, **rows(), **parameters()))
    verts, joints = MODEL.posed(pose())
    assert torch.allclose(found.verts, verts, atol=1e-6)
    assert torch.allclose(found.joints, joints, atol=1e-6)
    assert found.joint_names == MODEL.joint_names
    assert found.pose is not None
    assert not words
    (folder / "contacts.npz").unlink()
    save(folder, **rows(), **parameters())
    found = read_capture(folder)
    assert found.warnings == ()
    assert found.bodies.pose is not None


def test_meshes_count_and_parameters_stay_when_they_agree(tmp_path):
    meshes = meshes_of(0.004)
    found, words = read(save(tmp_path, **rows(), **parameters(), **meshes))
    assert (found.verts.numpy() == meshes["vertices"]).all()
    assert found.pose is not None
    assert not words


@pytest.mark.parametrize(("change", "words"), [
    ({"transl": np.zeros((ROWS, 3))}, "miss the meshes by up to"),
    ({"model": np.array("smplx")}, "cannot be used"),
    ({"body_pose": np.zeros((ROWS, 69))}, "cannot be used"),
])  # fmt: skip
def test_parameters_that_do_not_give_the_meshes_are_left_out_with_a_word(tmp_path, change, words):
    found, said = read(save(tmp_path, **rows(), **{**parameters(), **change}, **meshes_of()))
    assert found.pose is None
    assert words in said
    assert "rigidly" in said
    found, said = read(save(tmp_path, **tiny.bodies(), **parameters()))  # another topology
    assert found.pose is None
    assert "4" in said


@pytest.mark.parametrize(("change", "words"), [
    ({"model": np.array("smplx")}, "'model' has 'smplx'"),
    ({"model": np.array("star")}, "'model' has \"star\", expected one of"),
    ({"gender": np.array("x")}, "'gender' has \"x\""),
    ({"body_pose": np.zeros((ROWS, 64))}, "'body_pose' has 64, expected 63 or 69"),
    ({"body_pose": np.zeros((ROWS, 69))}, "'model' has 'makehuman'.*69"),
    ({"betas": np.zeros((2, 10))}, "'betas' has shape"),
    ({"transl": np.full((ROWS, 3), np.nan)}, "'transl' has nan at"),
    ({"global_orient": np.zeros((ROWS, 4))}, "'global_orient' has shape"),
    ({"left_hand_pose": np.zeros(45)}, "'left_hand_pose' has shape"),
    ({"size_spread": np.array(-0.1)}, "'size_spread' has -0.1, expected .* from 0 to 1"),
])  # fmt: skip
def test_wrong_parameters_are_named(tmp_path, change, words):
    path = save(tmp_path, **rows(), **{**parameters(), **change})
    with pytest.raises(InputError, match=words) as caught:
        read_bodies(path)
    assert str(caught.value).startswith("bodies.npz: field")


def test_people_of_the_mean_shape_are_of_unknown_height_also_where_no_model_checks_it(tmp_path):
    own = {k: v for k, v in parameters().items() if k != "model"}
    meshes = {k: v for k, v in tiny.bodies().items() if k in ("vertices", "faces")}
    found, _ = read(save(tmp_path, **rows(), **own, **meshes, model=np.array("smplx")))
    assert found.pose is None  # no file of that model is here
    assert found.mean_shape
    assert size_spread(found, 0.055) == 0.055
    own["betas"] = own["betas"] + 0.8
    found, _ = read(save(tmp_path, **rows(), **own, **meshes, model=np.array("smplx")))
    assert not found.mean_shape
    assert size_spread(found, 0.055) == 0
    found, _ = read(save(tmp_path, **rows(), **meshes))
    assert not found.mean_shape


def test_bodies_survive_writing(tmp_path):
    more = {"fps": np.array(12.5), "size_spread": np.array(0.03)}
    first, _ = read(save(tmp_path, **rows(), **parameters(), **more))
    write_bodies(first, tmp_path / "copy.npz")
    second, words = read(tmp_path / "copy.npz")
    assert not words
    assert torch.equal(first.verts, second.verts)
    for name in ("betas", "global_orient", "body_pose", "transl"):
        assert torch.equal(getattr(first.pose, name), getattr(second.pose, name))
    assert torch.equal(first.pose.extra["left_hand_pose"], second.pose.extra["left_hand_pose"])
    assert (second.fps, second.space, second.size_spread) == (12.5, "camera", 0.03)
    write_bodies(second, tmp_path / "again.npz")
    assert (tmp_path / "copy.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_parameters_of_world_bodies_turn_with_their_meshes(tmp_path):
    world, _ = read(save(tmp_path, **{**rows(), "space": np.array("world")}, **parameters()))
    R = torch.from_numpy(tiny.rotation(-0.3, 0.1, 0.8)).float()
    found = into_camera(world, R)
    assert found.space == "camera"
    assert torch.allclose(found.verts, world.verts @ R.mT, atol=1e-6)
    again, _ = MODEL.posed(found.pose)
    assert torch.allclose(again, found.verts, atol=2e-5)


def test_arrays_of_another_tool_are_named_with_what_reads_them(tmp_path):
    np.savez(tmp_path / "romp.npz", results=np.zeros(3), joints3d=np.zeros(2))
    said = r"romp\.npz: has 2 arrays \(results, joints3d\).*mover import-bodies TOOL"
    with pytest.raises(InputError, match=said):
        read_bodies(tmp_path / "romp.npz")
