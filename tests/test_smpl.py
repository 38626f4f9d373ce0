import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from make_keypoints import random_pose, rest_pose
from make_smpl import make_model, write_models, write_npz, write_old_pickle

from mover.bodies import BODY_MODELS, BodyModel, load_model
from mover.bodies.parts import PARTS, members, parts_of
from mover.bodies.skeleton import JOINTS, PARENTS
from mover.bodies.skinning import FLAT, open_body, vertex_subset
from mover.bodies.smpl_files import FOLDER, find_file, load_smpl
from mover.core.errors import InputError
from mover.core.records import map_tensors
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals
from mover.io.capture.bodies_file import read_bodies, write_bodies

COUNTS = {"smpl": (6890, 24, 69), "smplh": (6890, 52, 63), "smplx": (10475, 55, 63)}


@pytest.fixture(scope="module")
def arrays():
    return {name: make_model(name) for name in COUNTS}


@pytest.fixture(scope="module")
def folder(arrays, tmp_path_factory):
    root = write_models(tmp_path_factory.mktemp("models"))
    write_old_pickle(arrays["smpl"], root / "smpl" / "SMPL_NEUTRAL.pkl")
    return root


def rotation(vector):
    """Rodrigues' formula for one vector."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def textbook(model, betas, face, angles, transl):
    """One body by loops over joints, from the arrays of the file, in numpy alone."""
    expression = model["shapedirs"][..., 10:20] if len(face) else np.zeros((1, 3, 0))
    rest = model["v_template"] + model["shapedirs"][..., : len(betas)].astype(float) @ betas
    rest = rest + expression.astype(float) @ face
    joints = model["J_regressor"] @ rest
    turns = [rotation(a) for a in angles]
    features = np.concatenate([(R - np.eye(3)).ravel() for R in turns[1:]])
    rest = rest + model["posedirs"].astype(float) @ features
    chain = []
    for joint, R in enumerate(turns):
        local = np.eye(4)
        local[:3, :3] = R
        parent = int(model["kintree_table"].astype(np.int32)[0, joint])
        local[:3, 3] = joints[joint] - (joints[parent] if joint else 0)
        chain.append(chain[parent] @ local if joint else local)
    verts = np.zeros_like(rest)
    for joint, moved in enumerate(chain):
        here = (rest - joints[joint]) @ moved[:3, :3].T + moved[:3, 3]
        verts += model["weights"][:, [joint]] * here
    return verts + transl, np.array([m[:3, 3] for m in chain]) + transl


@pytest.mark.parametrize("name", COUNTS)
def test_models_equal_the_textbook_loop_over_joints(arrays, folder, name):
    model, source = load_smpl(name, place=folder), arrays[name]
    pose = random_pose(model)
    verts, joints = model.posed(pose)
    for row in range(2):
        parts = [pose.global_orient[row], pose.body_pose[row]]
        if name == "smplx":
            parts += [pose.extra[k][row] for k in ("jaw_pose", "leye_pose", "reye_pose")]
        if name != "smpl":
            means = ((side, source[f"hands_mean{side[0]}"]) for side in ("left", "right"))
            parts += [pose.extra[f"{s}_hand_pose"][row] + torch.from_numpy(m) for s, m in means]
        angles = torch.cat([p.double() for p in parts]).reshape(-1, 3).numpy()
        face = pose.extra["expression"][row].double().numpy() if name == "smplx" else np.zeros(0)
        betas, transl = pose.betas[row].double().numpy(), pose.transl[row].numpy()
        expected = textbook(source, betas, face, angles, transl)
        np.testing.assert_allclose(verts[row], expected[0], atol=3e-6)
        np.testing.assert_allclose(joints[row], expected[1], atol=3e-6)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("components", [12, 45])
@pytest.mark.parametrize("name", ["smplh", "smplx"])
def test_models_equal_the_smplx_package(folder, name, components, flat):
    smplx = pytest.importorskip("smplx")
    model = load_smpl(name, place=folder)
    pose = random_pose(model, 3, seed=4)
    hands = {f"{side}_hand_pose": pose.extra[f"{side}_hand_pose"][:, :components]
             for side in ("left", "right")}  # fmt: skip
    pose = replace(pose, extra={**pose.extra, **hands, FLAT: torch.full((3, 1), float(flat))})
    other = smplx.create(
        str(folder / name / f"{name.upper()}_NEUTRAL.npz"), model_type=name, ext="npz",
        use_pca=components != 45, num_pca_comps=components, flat_hand_mean=flat,
    )  # fmt: skip
    check_same(model, pose, other)
    assert np.array_equal(model.faces.numpy(), other.faces)


def check_same(model, pose, other):
    """The other package's model gives the same vertices and joints."""
    given = {k: getattr(pose, k) for k in ("betas", "global_orient", "body_pose", "transl")}
    found = other(**given, **{k: v for k, v in pose.extra.items() if k != FLAT})
    verts, joints = model.posed(pose)
    torch.testing.assert_close(verts, found.vertices, atol=2e-6, rtol=0)
    torch.testing.assert_close(joints, found.joints[:, : joints.shape[1]], atol=2e-6, rtol=0)


@pytest.mark.filterwarnings("ignore")
def test_smpl_equals_the_smplx_package(arrays, folder, tmp_path):
    smplx = pytest.importorskip("smplx")
    plain = tmp_path / "SMPL_NEUTRAL.pkl"  # the package needs chumpy for the true files
    plain.write_bytes(pickle.dumps(arrays["smpl"]))
    model = load_smpl("smpl", place=folder)
    check_same(model, random_pose(model, 1, seed=5), smplx.create(str(plain), model_type="smpl"))


def test_the_chumpy_pickle_gives_the_same_body_as_the_npz(arrays, folder):
    npz = write_npz(arrays["smpl"], folder / "other" / "SMPL_NEUTRAL.npz")
    one, two = load_smpl("smpl", place=folder), load_smpl("smpl", place=npz)
    pose = random_pose(one)
    assert torch.equal(one.posed(pose)[0], two.posed(pose)[0])


@pytest.mark.slow
def test_files_of_version_1_1_have_300_numbers_of_shape_and_100_of_expression(tmp_path):
    source = make_model("smplx", "1.1")
    path = write_npz(source, tmp_path / "SMPLX_NEUTRAL.npz")
    model = load_smpl("smplx", place=path)
    assert model.shape_dirs.shape == (10475, 3, 300)
    assert model.expression_dirs.shape == (10475, 3, 100)
    pose = replace(rest_pose(1, model), extra={FLAT: torch.ones(1, 1)})
    smiling = replace(pose, extra={**pose.extra, "expression": torch.ones(1, 100)})
    moved = torch.from_numpy(source["shapedirs"][..., 300:].sum(-1))
    smile = model.posed(smiling)[0] - model.posed(pose)[0]
    torch.testing.assert_close(smile[0], moved, atol=1e-6, rtol=0)
    long = replace(pose, betas=torch.zeros(1, 300))
    assert model.posed(long)[0].shape == (1, 10475, 3)


@pytest.mark.parametrize("name", BODY_MODELS)
def test_models_keep_the_protocol_and_are_found_by_the_environment(folder, name, monkeypatch):
    monkeypatch.setenv(FOLDER, str(folder))
    model = load_model(name)
    verts, joints, angles = {**COUNTS, "makehuman": (5002, 55, 63)}[name]
    assert isinstance(model, BodyModel)
    assert model.name == name
    assert len(model.joint_names) == joints
    pose = rest_pose(3, model)
    assert pose.body_pose.shape == (3, angles)
    skin, places = model.posed(pose)
    assert skin.shape == (3, verts, 3)
    assert places.shape == (3, joints, 3)
    assert int(model.faces.max()) == verts - 1
    assert load_model(name) is model  # read once


def test_the_skeletons_are_cut_from_that_of_smplx(folder):
    assert load_smpl("smplx", place=folder).parents == PARENTS
    hands = load_smpl("smplh", place=folder)
    named = {n: JOINTS[PARENTS[k]] for k, n in enumerate(JOINTS)}
    for joint, parent in enumerate(hands.parents[1:], start=1):
        assert hands.joint_names[parent] == named[hands.joint_names[joint]]
    body = load_smpl("smpl", place=folder)
    assert body.joint_names[22:] == ("left_hand", "right_hand")
    assert body.parents[22:] == (20, 21)


def test_gradients_reach_every_parameter(folder):
    model = load_smpl("smplx", place=folder)
    model = map_tensors(lambda x: x.double() if x.is_floating_point() else x, model)
    tiny = vertex_subset(model, torch.arange(0, 10475, 2500))
    start = map_tensors(torch.Tensor.double, random_pose(model, 1))

    def posed(betas, face, hand, body):
        extra = {**start.extra, "expression": face, "left_hand_pose": hand}
        return tiny.posed(replace(start, betas=betas, body_pose=body, extra=extra))[0]

    values = [start.betas, start.extra["expression"], torch.zeros(1, 6).double(), start.body_pose]
    assert torch.autograd.gradcheck(posed, [v.clone().requires_grad_() for v in values])


def test_hands_that_are_not_given_rest_at_the_mean_and_flat_ones_are_flat(arrays, folder):
    model = load_smpl("smplx", place=folder)
    rest = rest_pose(1, model)
    mean = torch.from_numpy(arrays["smplx"]["hands_meanl"]).float()[None]
    flat = torch.ones(1, 1)
    right = torch.from_numpy(arrays["smplx"]["hands_meanr"]).float()[None]
    given = {"left_hand_pose": mean, "right_hand_pose": right, FLAT: flat}
    same = model.posed(replace(rest, extra=given))[0]
    torch.testing.assert_close(model.posed(rest)[0], same, atol=1e-6, rtol=0)
    straight = model.posed(replace(rest, extra={FLAT: flat}))[0]
    plain = replace(model, pose_dirs=None, hands=None)  # no correctives in the zero pose
    expected = plain.posed(rest)[0]
    torch.testing.assert_close(straight, expected, atol=1e-6, rtol=0)


def test_smpl_takes_the_21_joints_of_other_models_and_leaves_the_palms_straight(folder):
    model = load_smpl("smpl", place=folder)
    pose = random_pose(model)
    short = replace(pose, body_pose=pose.body_pose[:, :63])
    long = replace(pose, body_pose=torch.cat([short.body_pose, torch.zeros(2, 6)], 1))
    assert torch.equal(model.posed(short)[0], model.posed(long)[0])


@pytest.mark.parametrize("name", COUNTS)
def test_parts_of_these_bodies_come_from_their_skins(folder, name, monkeypatch):
    monkeypatch.setenv(FOLDER, str(folder))
    model = load_model(name)
    rest = rest_pose(1, model)
    verts, joints = model.posed(rest)
    zero = torch.zeros(1, dtype=torch.long)
    for pose in (rest, None):  # the mesh alone is known as well
        bodies = Bodies(verts, model.faces, None, (), zero, zero, None, "world", pose)
        parts = parts_of(bodies)
        normals = vertex_normals(verts, model.faces)[0]
        place = dict(zip(model.joint_names, joints[0], strict=True))
        for part in PARTS:
            assert members(parts, part).sum() > 15, part
        middle = {p: verts[0, members(parts, p)].mean(0) for p in PARTS}
        for side, sign in (("left", 1), ("right", -1)):
            assert sign * (middle[f"{side}_palm"] - place["pelvis"])[0] > 0.6
            assert (normals[members(parts, f"{side}_sole")].mean(0))[1] < -0.6
            assert middle[f"{side}_sole"][1] < place[f"{side}_foot"][1] + 0.02
            assert middle[f"{side}_thigh"][2] < place[f"{side}_hip"][2]
        assert place["left_knee"][1] < middle["seat"][1] < place["spine1"][1]
        assert normals[members(parts, "back")].mean(0)[2] < -0.5


def test_bodies_npz_with_parameters_of_smplx_gives_its_meshes(folder, tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(folder))
    model = load_model("smplx")
    pose = random_pose(model)
    pose = replace(pose, extra={**pose.extra, FLAT: torch.ones(2, 1)})
    verts, joints = model.posed(pose)
    index = torch.arange(2)
    none, names = torch.zeros_like(index), model.joint_names
    bodies = Bodies(verts, model.faces, joints, names, index, none, 30.0, "camera", pose)
    write_bodies(bodies, tmp_path / "bodies.npz")
    again = read_bodies(tmp_path / "bodies.npz")
    assert again.pose is not None  # the model reproduces the meshes within 1 cm
    torch.testing.assert_close(model.posed(again.pose)[0], verts, atol=1e-6, rtol=0)
    with np.load(tmp_path / "bodies.npz") as data:
        meshes = ("vertices", "faces", "joints", "joint_names")
        few = {k: data[k] for k in data.files if k not in meshes}
    np.savez(tmp_path / "bodies.npz", **few)
    torch.testing.assert_close(read_bodies(tmp_path / "bodies.npz").verts, verts, atol=1e-6, rtol=0)


def test_without_the_folder_the_message_says_what_to_set(monkeypatch, tmp_path):
    monkeypatch.delenv(FOLDER, raising=False)
    with pytest.raises(InputError, match=r"'smplx' is licensed.*MOVER_BODY_MODELS.*SMPLX_NEUTRAL"):
        load_model("smplx")
    (tmp_path / "SMPLX_MALE.npz").touch()
    monkeypatch.setenv(FOLDER, str(tmp_path))
    with pytest.raises(InputError, match=r"'smplx' \(female\).*SMPLX_FEMALE.*found SMPLX_MALE.npz"):
        load_model("smplx", "female")


@pytest.mark.parametrize(("path", "name", "gender"), [
    ("smplx/SMPLX_NEUTRAL.npz", "smplx", "neutral"),
    ("SMPLX_FEMALE.pkl", "smplx", "female"),
    ("models/smplh/SMPLH_MALE.pkl", "smplh", "male"),
    ("smplh/male/model.npz", "smplh", "male"),
    ("smpl/basicModel_f_lbs_10_207_0_v1.0.0.pkl", "smpl", "female"),
    ("basicmodel_m_lbs_10_207_0_v1.1.0.pkl", "smpl", "male"),
])  # fmt: skip
def test_files_are_found_in_all_usual_places(tmp_path, path, name, gender):
    (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / path).touch()
    assert find_file(name, gender, tmp_path) == tmp_path / path
    assert find_file(name, gender, tmp_path / path) == tmp_path / path


def broken(arrays, **changes):
    return {k: v for k, v in {**arrays, **changes}.items() if v is not None}


def test_a_file_of_another_model_or_with_odd_arrays_is_refused_by_name(arrays, tmp_path):
    good = arrays["smplx"] | {"posedirs": arrays["smplx"]["posedirs"].astype(np.float16)}  # small
    cases = [
        (arrays["smplh"], "'v_template' has 6890 vertices, those of smpl and smplh, expected 104"),
        (broken(good, posedirs=None), r"'posedirs' is missing.*found .*J_regressor.*weights"),
        (broken(good, hands_meanl=None), r"'hands_meanl' is missing"),
        (broken(good, weights=good["weights"][:, :24]), r"'weights' has shape \(10475, 24\)"),
        (broken(good, v_template=good["v_template"][:9]), r"shape \(9, 3\).*\(10475, 3\)"),
        (broken(good, shapedirs=good["shapedirs"][..., :16]), r"16 components, expected 20"),
        (broken(good, f=good["f"] + 9), r"'f' has odd numbers, expected 0 to 10474"),
        (broken(good, v_template=good["v_template"] * np.nan), r"not finite"),
        (broken(good, kintree_table=good["kintree_table"][:, ::-1]), r"'kintree_table' is not"),
        (broken(good, weights=good["weights"].astype(object)), r"'weights' is a pickled object"),
    ]
    for changed, message in cases:
        path = write_npz(changed, tmp_path / "SMPLX_NEUTRAL.npz")
        with pytest.raises(InputError, match=rf"^SMPLX_NEUTRAL\.npz: field.*{message}"):
            load_smpl("smplx", place=path)
    for name, content, message in (
        ("broken.npz", b"PK\x03\x04", r"broken\.npz: cannot be read"),
        ("list.pkl", pickle.dumps([1]), r"list\.pkl: is no dictionary"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=message):
            load_smpl("smplx", place=tmp_path / name)


def test_too_many_numbers_of_pose_and_shape_are_refused(folder):
    smplx, shipped = load_smpl("smplx", place=folder), open_body()
    for model, name, count, message in (
        (smplx, "betas", 11, r"'betas' has 11 columns"),
        (smplx, "body_pose", 69, r"'body_pose' has 69 columns.*expects 63"),
        (smplx, "expression", 50, r"'expression' has 50 columns.*knows 10"),
        (smplx, "left_hand_pose", 46, r"'left_hand_pose' has 46"),
        (smplx, "jaw_pose", 2, r"'jaw_pose' has 2 columns"),
        (shipped, "betas", 16, r"'betas' has 16 columns"),
        (shipped, "body_pose", 69, r"'body_pose' has 69 columns.*expects 63"),
        (shipped, "left_hand_pose", 6, r"'left_hand_pose' has 6 columns"),
    ):
        rest, change = rest_pose(1, model), {name: torch.ones(1, count)}
        change = change if hasattr(rest, name) else {"extra": change}
        with pytest.raises(InputError, match=message):
            model.posed(replace(rest, **change))
