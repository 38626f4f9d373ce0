import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from figures import SEATED, pose
from make_keypoints import rest_pose
from make_smpl import make_model, write_npz
from scipy import sparse

from mover.bodies.skinning import open_body
from mover.bodies.smpl_files import FOLDER, load_smpl
from mover.bodies.smpl_model import FLAT
from mover.bodies.transfer import TransferConfig, copy_pose, find_matrix, read_matrix, transfer
from mover.core.errors import InputError

COMMON = 22


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    found = {"makehuman": open_body()}
    for name in ("smpl", "smplh", "smplx"):
        path = write_npz(make_model(name), root / name / f"{name.upper()}_NEUTRAL.npz")
        found[name] = load_smpl(name, place=path)
    return found


def people(model, bodies=3, seed=0):
    """One person in several poses."""
    generator = torch.Generator().manual_seed(seed)

    def some(*shape):
        return torch.randn(*shape, generator=generator)

    zero = rest_pose(bodies, model)
    angles = 0.25 * some(*zero.body_pose.shape)
    angles[:, 63:] = 0
    return replace(
        zero, betas=some(1, 10).expand(bodies, 10).clone(), global_orient=some(bodies, 3),
        body_pose=angles, transl=some(bodies, 3),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["smplx", "makehuman"])
def test_a_body_goes_into_its_own_model_as_itself(models, name):
    model = models[name]
    source = people(model)
    found = transfer(source, model, model)
    verts = model.posed(source)[0]
    assert (model.posed(found.pose)[0] - verts).norm(dim=-1).max() < 0.003
    assert found.miss.max() < 0.0005


@pytest.mark.parametrize(
    ("first", "second"),
    [("smpl", "smplh"), ("smpl", "smplx"), ("smplx", "makehuman"), ("makehuman", "smpl")],
)
def test_joints_stay_where_they_are_and_the_pose_hardly_turns(models, first, second):
    source = people(models[first])
    found = transfer(source, models[first], models[second])
    before = models[first].posed(source)[1][:, :COMMON]
    after = models[second].posed(found.pose)[1][:, :COMMON]
    assert found.pose.model == second
    assert (after - before).norm(dim=-1).mean() < 0.012
    turned = (found.pose.body_pose[:, :63] - source.body_pose[:, :63]).abs()
    assert turned.mean() < 0.06
    assert (found.pose.betas == found.pose.betas[:1]).all()  # still one person


def test_shape_and_place_alone_leave_the_pose_as_copied(models):
    source = people(models["smpl"])
    found = transfer(source, models["smpl"], models["smplx"], TransferConfig(free_pose=False))
    assert torch.equal(found.pose.body_pose, source.body_pose[:, :63])
    assert torch.equal(found.pose.global_orient, source.global_orient)
    better = transfer(source, models["smpl"], models["smplx"])
    assert better.miss.mean() < found.miss.mean()


def test_people_of_two_shapes_keep_two_shapes(models):
    one, two = people(models["smpl"], 2, seed=1), people(models["smpl"], 2, seed=2)
    both = replace(
        one, betas=torch.cat([one.betas[:1], two.betas[:1], one.betas[:1]]),
        body_pose=torch.zeros(3, 69), global_orient=torch.zeros(3, 3), transl=torch.zeros(3, 3),
    )  # fmt: skip
    found = transfer(both, models["smpl"], models["smplh"]).pose.betas
    assert torch.equal(found[0], found[2])
    assert (found[0] - found[1]).abs().max() > 0.1


def test_hands_are_copied_as_angles_from_flat_and_rest_where_there_are_none(models):
    model = models["smplx"]
    generator = torch.Generator().manual_seed(0)
    few = {f"{s}_hand_pose": torch.randn(1, 6, generator=generator) for s in ("left", "right")}
    source = replace(rest_pose(1, model), extra=few)
    copied = copy_pose(source, model, models["smplh"])
    assert copied.extra["left_hand_pose"].shape == (1, 45)
    assert (copied.extra[FLAT] == 1).all()
    again = copy_pose(source, model, model)
    torch.testing.assert_close(model.posed(again)[0], model.posed(source)[0], atol=1e-6, rtol=0)
    none = copy_pose(rest_pose(1, models["smpl"]), models["smpl"], model)
    assert none.extra == {}


def test_a_seated_open_body_sits_in_smplx_as_well(models):
    found = transfer(pose(SEATED), open_body(), models["smplx"])
    _, joints = models["smplx"].posed(found.pose)
    place = dict(zip(models["smplx"].joint_names, joints[0], strict=True))
    thigh = place["left_knee"] - place["left_hip"]
    assert thigh[2] > 0.9 * thigh.norm()
    assert place["head"][1] > place["pelvis"][1] + 0.4
    assert found.miss.max() < 0.015


def official(path, dense, key="mtx"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps({key: sparse.csc_matrix(dense)}, protocol=2))
    return path


@pytest.fixture(scope="module")
def matrix_file(models, tmp_path_factory):
    """The nearest three vertices in the T-pose; columns behind them act on normals."""
    from scipy.spatial import KDTree

    first, second = (models[n].skin.verts.numpy() for n in ("smpl", "smplx"))
    far, near = KDTree(first).query(second, k=3)
    share = 1 / (far + 1e-4)
    rows = np.repeat(np.arange(len(second)), 3)
    values = (share / share.sum(1, keepdims=True)).ravel()
    dense = sparse.coo_matrix((values, (rows, near.ravel())), shape=(10475, 13780))
    path = tmp_path_factory.mktemp("data") / "transfer_data" / "smpl2smplx_deftrafo_setup.pkl"
    return official(path, dense)


def test_the_official_matrix_gives_smplx_the_vertices_of_smpl(models, matrix_file, monkeypatch):
    monkeypatch.setenv(FOLDER, str(matrix_file.parents[1]))
    assert find_matrix("smpl", "smplx") == matrix_file
    assert find_matrix("smplx", "smpl") is None
    matrix = read_matrix(matrix_file, "smpl", "smplx")
    source = people(models["smpl"], 2)
    found = transfer(source, models["smpl"], models["smplx"], matrix=matrix)
    verts = models["smpl"].posed(source)[0].numpy()
    with open(matrix_file, "rb") as file:
        full = pickle.load(file)["mtx"].tocsr()[:, :6890]
    after = models["smplx"].posed(found.pose)[0].numpy()
    miss = np.stack(
        [np.linalg.norm(full @ v - w, axis=-1) for v, w in zip(verts, after, strict=True)]
    )
    assert miss.mean() < 0.01
    sampled = np.sqrt(np.square(miss).mean(1))
    np.testing.assert_allclose(found.miss, sampled, rtol=0.25)  # 1,200 stand for all


def test_rows_of_a_matrix_are_those_of_the_file(matrix_file):
    matrix = read_matrix(matrix_file, "smpl", "smplx")
    with open(matrix_file, "rb") as file:
        full = pickle.load(file)["mtx"].toarray()[:, :6890]
    wanted = torch.tensor([7, 3, 10474])
    used, mix = matrix.rows(wanted)
    np.testing.assert_allclose(mix, full[wanted][:, used], atol=1e-7)
    assert np.count_nonzero(full[wanted]) == int((mix != 0).sum())


def test_matrices_of_other_models_or_without_their_key_are_refused(tmp_path, models, matrix_file):
    path = official(tmp_path / "a.pkl", np.eye(5))
    with pytest.raises(
        InputError, match=r"a\.pkl: field 'mtx' has shape \(5, 5\).*\(10475, 6890\)"
    ):
        read_matrix(path, "smpl", "smplx")
    official(tmp_path / "a.pkl", np.eye(5), key="other")
    with pytest.raises(InputError, match=r"'mtx' or 'matrix' is missing; found other"):
        read_matrix(path, "smpl", "smplx")
    matrix = read_matrix(matrix_file, "smpl", "smplx")
    with pytest.raises(ValueError, match="the models have"):
        transfer(people(models["smplh"]), models["smplh"], models["makehuman"], matrix=matrix)


def test_a_mask_beside_the_matrix_says_which_vertices_count(matrix_file):
    mask = matrix_file.with_name("smplx_mask_ids.npy")
    np.save(mask, np.array([5, 3, 9]))
    try:
        assert read_matrix(matrix_file, "smpl", "smplx").valid.tolist() == [3, 5, 9]
        np.save(mask, np.array([0.5]))
        with pytest.raises(InputError, match=r"smplx_mask_ids\.npy"):
            read_matrix(matrix_file, "smpl", "smplx")
    finally:
        mask.unlink()


def test_imported_bodies_change_to_another_model_by_the_matrix(
    models, matrix_file, monkeypatch, capsys
):
    """`mover import-bodies TOOL SOURCE --transfer smplx`, with and without the official file."""
    from mover.app.cli.people import BodiesArgs, _transferred
    from mover.bodies import smpl_files
    from mover.core.types import Bodies

    monkeypatch.setattr(smpl_files, "load_smpl", lambda name, _: models[name])
    monkeypatch.setenv(FOLDER, str(matrix_file.parents[1]))
    source = people(models["smpl"])
    verts, joints = models["smpl"].posed(source)
    zero = torch.zeros(3).long()
    given = Bodies(
        verts, models["smpl"].faces, joints, models["smpl"].joint_names, torch.arange(3), zero,
        30.0, "camera", source,
    )  # fmt: skip
    args = BodiesArgs("pare", matrix_file, transfer="smplx")
    found = _transferred(given, args)
    assert found.verts.shape[1] == 10475
    assert found.pose.model == "smplx"
    assert "by smpl2smplx_deftrafo_setup.pkl" in capsys.readouterr().out
    monkeypatch.delenv(FOLDER)
    _transferred(given, args)
    assert "by joints and matched skin" in capsys.readouterr().out
    with pytest.raises(InputError, match="of smplx already"):
        _transferred(found, args)
    with pytest.raises(InputError, match="meshes only"):
        _transferred(replace(given, pose=None), args)
