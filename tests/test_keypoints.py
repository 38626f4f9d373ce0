from dataclasses import replace

import numpy as np
import pytest
import torch
from figures import SEATED, pose, turned
from make_keypoints import rest_pose

from mover.bodies.keypoints import LAYOUTS, keypoints_of, spots_of
from mover.bodies.skinning import open_body, zero_pose
from mover.bodies.smpl_files import load_smpl
from mover.geometry.mesh import vertex_normals

BODIES = ("small", "full")


def named(model, layout, base=None):
    verts, joints = model.posed(rest_pose(1, model) if base is None else base)
    points = keypoints_of(model, verts, joints, layout)[0]
    return dict(zip(LAYOUTS[layout], points, strict=True))


def test_layouts_have_the_order_of_their_detectors():
    sizes = {"openpose25": 25, "openpose137": 137, "smplifyx118": 118, "coco17": 17}
    sizes |= {"halpe26": 26, "wholebody133": 133, "mediapipe33": 33}
    assert {name: len(points) for name, points in LAYOUTS.items()} == sizes
    body = dict(enumerate(LAYOUTS["openpose25"]))
    wanted = {
        0: "nose", 1: "neck", 4: "right_wrist", 7: "left_wrist", 8: "pelvis", 10: "right_knee",
        15: "right_eye", 18: "left_ear", 19: "left_big_toe", 21: "left_heel", 24: "right_heel",
    }  # fmt: skip
    assert {k: body[k] for k in wanted} == wanted
    whole = LAYOUTS["wholebody133"]
    assert whole[17:23] == LAYOUTS["openpose25"][19:]
    wanted = {
        5: "left_shoulder", 16: "right_ankle", 23: "face_00", 91: "left_wrist",
        95: "left_thumb_tip", 96: "left_index1", 111: "left_pinky_tip", 112: "right_wrist",
    }  # fmt: skip
    assert {k: whole[k] for k in wanted} == wanted
    halpe = LAYOUTS["halpe26"]
    assert halpe[17:22] == ("head_top", "neck", "pelvis", "left_big_toe", "right_big_toe")
    assert halpe[24:] == ("left_heel", "right_heel")


def test_the_map_of_whole_bodies_to_openpose_says_the_same_as_the_names():
    """The numbers are those of the map between the two detectors; means are neck and mid-hip."""
    order = [0, None, 6, 8, 10, 5, 7, 9, None, 12, 14, 16, 11, 13, 15, 2, 1, 4, 3, *range(17, 23)]
    for k, source in enumerate(order):
        if source is not None:
            assert LAYOUTS["openpose25"][k] == LAYOUTS["wholebody133"][source]


@pytest.mark.parametrize("detail", BODIES)
def test_points_of_the_open_body_are_where_people_have_them(detail):
    model = open_body(detail)
    at = named(model, "wholebody133") | named(model, "halpe26")
    verts, joints = (x[0] for x in model.posed(zero_pose(1, model)))
    place = dict(zip(model.joint_names, joints, strict=True))
    head = at["head_top"][1] - place["neck"][1]
    assert at["head_top"][1] == verts[:, 1].max()
    assert at["nose"][2] > at["left_eye"][2] + 0.01
    assert abs(float(at["nose"][0])) < 0.01
    assert place["jaw"][1] < at["nose"][1] < at["left_eye"][1] < at["head_top"][1] - 0.3 * head
    for side, sign in (("left", 1), ("right", -1)):
        assert sign * at[f"{side}_eye"][0] > 0.02
        assert sign * at[f"{side}_ear"][0] > 0.07
        assert at[f"{side}_ear"][2] < at[f"{side}_eye"][2] - 0.05
        assert abs(float(at[f"{side}_ear"][1] - at["nose"][1])) < 0.06
        big, small, heel = (at[f"{side}_{n}"] for n in ("big_toe", "small_toe", "heel"))
        assert big[2] > small[2] > place[f"{side}_foot"][2] > heel[2] + 0.1
        assert sign * (small[0] - big[0]) > 0.04
        assert 0.2 < float((big - heel).norm()) < 0.3  # the foot of an adult
        assert max(big[1], small[1], heel[1]) < verts[:, 1].min() + 0.04
        for finger in ("index", "middle", "ring", "pinky", "thumb"):
            tip, last, before = (at.get(f"{side}_{finger}{k}") for k in ("_tip", 3, 2))
            bone, end = last - before, tip - last
            assert 0.008 < float(end.norm()) < 0.04
            assert float(bone @ end / bone.norm() / end.norm()) > 0.8


def test_left_points_mirror_right_ones():
    at = named(open_body("full"), "wholebody133")
    for name, point in at.items():
        if name.startswith("left"):
            mirror = at[name.replace("left", "right")] * torch.tensor([-1.0, 1, 1])
            torch.testing.assert_close(point, mirror, atol=0.012, rtol=0)


def test_both_details_of_the_open_body_have_the_same_points():
    one, two = (named(open_body(d), "wholebody133") for d in BODIES)
    for name, point in one.items():
        torch.testing.assert_close(point, two[name], atol=0.015, rtol=0, equal_nan=True)


def test_points_lie_on_the_skin_and_face_outwards():
    model = open_body()
    verts, _ = model.posed(zero_pose(1, model))
    at = named(model, "openpose25")
    normals = vertex_normals(verts, model.faces)[0]

    def facing(name):
        return normals[(verts[0] - at[name]).norm(dim=-1).argmin()]

    assert facing("nose")[2] > 0.7
    assert facing("left_big_toe")[2] > 0.5
    assert facing("right_heel")[2] < -0.7


def test_points_move_with_the_body_and_carry_gradients():
    model = open_body()
    base = turned(pose(SEATED), 0.2, 1.0, -0.3)
    verts, joints = model.posed(base)
    joints.requires_grad_()
    verts.requires_grad_()
    points = keypoints_of(model, verts, joints, "openpose25")
    assert points.shape == (1, 25, 3)
    everything = torch.cat([verts, joints], 1).detach()
    far = torch.cdist(points.detach().double(), everything.double()).amin(-1)
    assert far.max() < 1e-6
    points.sum().backward()
    assert joints.grad[0].abs().sum() == 3 * 14  # 14 of the 25 are joints
    assert verts.grad[0].abs().sum() == 3 * 11


def test_what_a_model_does_not_have_is_nan_and_is_said():
    model = open_body()
    at = named(model, "wholebody133")
    missing = [n for n, p in at.items() if not p.isfinite().all()]
    assert missing == [f"face_{k:02d}" for k in range(68)]
    has = spots_of(model, "wholebody133").there
    assert has.sum() == 133 - 68
    with pytest.raises(ValueError, match=r"no layout 'mpii'.*coco17"):
        keypoints_of(model, torch.zeros(1, 5002, 3), torch.zeros(1, 55, 3), "mpii")


ORDER = [
    55, 12, 17, 19, 21, 16, 18, 20, 0, 2, 5, 8, 1, 4, 7, *range(56, 66),
    20, 37, 38, 39, 66, 25, 26, 27, 67, 28, 29, 30, 68, 34, 35, 36, 69, 31, 32, 33, 70,
    21, 52, 53, 54, 71, 40, 41, 42, 72, 43, 44, 45, 73, 49, 50, 51, 74, 46, 47, 48, 75,
    *range(76, 127),
]  # fmt: skip


@pytest.mark.filterwarnings("ignore")
def test_all_118_keypoints_of_smplx_equal_those_of_the_smplx_package(smpl_models):
    smplx = pytest.importorskip("smplx")
    model = load_smpl("smplx", place=smpl_models)
    generator = torch.Generator().manual_seed(2)
    base = rest_pose(2, model)
    base = replace(base, body_pose=0.4 * torch.randn(2, 63, generator=generator))
    file = smpl_models / "smplx" / "SMPLX_NEUTRAL.npz"
    other = smplx.create(str(file), model_type="smplx", batch_size=2)
    found = other(body_pose=base.body_pose, betas=base.betas)
    points = keypoints_of(model, *model.posed(base), "smplifyx118")
    torch.testing.assert_close(points, found.joints[:, ORDER], atol=2e-6, rtol=0)


@pytest.mark.filterwarnings("ignore")
def test_feet_face_and_tips_of_smplh_equal_those_of_the_smplx_package(smpl_models):
    smplx = pytest.importorskip("smplx")
    model = load_smpl("smplh", place=smpl_models)
    file = smpl_models / "smplh" / "SMPLH_NEUTRAL.npz"
    found = smplx.create(str(file), model_type="smplh", ext="npz")().joints[0, 52:]
    at = named(model, "openpose137")
    names = ["nose", "right_eye", "left_eye", "right_ear", "left_ear"]
    names += [f"{s}_{n}" for s in ("left", "right") for n in ("big_toe", "small_toe", "heel")]
    fingers = ("thumb", "index", "middle", "ring", "pinky")
    names += [f"{s}_{f}_tip" for s in ("left", "right") for f in fingers]
    points = torch.stack([at[n] for n in names])
    torch.testing.assert_close(points, found, atol=2e-6, rtol=0)


def test_points_of_the_synthetic_smplx_are_those_of_the_open_body_but_a_contour(smpl_models):
    model = load_smpl("smplx", place=smpl_models)
    open_ones = named(open_body(), "openpose25")
    shift = torch.tensor([0.02, 0.31, -0.05])
    for name, point in named(model, "openpose25").items():
        assert (point - shift - open_ones[name]).norm() < 0.025, name
    has = spots_of(model, "wholebody133").there
    assert np.flatnonzero(~has.numpy()).tolist() == list(range(23, 40))
    assert spots_of(model, "halpe26").there.all()
