"""SMPL bodies as SMPL-X bodies by the official matrix, and a fit that starts from them."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from make_keypoints import random_pose
from scipy import sparse

from mover.bodies.smpl_files import FOLDER, as_smplx, find_matrix, load_smpl, read_matrix
from mover.core.errors import InputError
from mover.fitting.start import _by_matrix


@pytest.fixture(scope="module")
def models(smpl_models):
    return {name: load_smpl(name, place=smpl_models) for name in ("smpl", "smplx")}


def people(model, bodies=3, seed=0):
    """One person in several poses."""
    some = random_pose(model, bodies, seed, size=0.25)
    angles = some.body_pose.clone()
    angles[:, 63:] = 0
    return replace(some, betas=some.betas[:1].expand(bodies, 10).clone(), body_pose=angles)


def official(path, dense, key="mtx"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps({key: sparse.csc_matrix(dense)}, protocol=2))
    return path


@pytest.fixture(scope="module")
def matrix_file(models, smpl_models):
    """The nearest three vertices in the T-pose; columns behind them act on normals."""
    from scipy.spatial import KDTree

    first, second = (models[n].verts.numpy() for n in ("smpl", "smplx"))
    far, near = KDTree(first).query(second, k=3)
    share = 1 / (far + 1e-4)
    rows = np.repeat(np.arange(len(second)), 3)
    values = (share / share.sum(1, keepdims=True)).ravel()
    dense = sparse.coo_matrix((values, (rows, near.ravel())), shape=(10475, 13780))
    return official(smpl_models / "transfer_data" / "smpl2smplx_deftrafo_setup.pkl", dense)


@pytest.fixture(scope="module")
def moved(models, matrix_file):
    """People of SMPL, and as SMPL-X."""
    source = people(models["smpl"], 2)
    return source, as_smplx(source, models["smpl"], models["smplx"], read_matrix(matrix_file))


def test_the_official_matrix_gives_smplx_the_vertices_of_smpl(
    models, matrix_file, moved, monkeypatch
):
    monkeypatch.setenv(FOLDER, str(matrix_file.parents[1]))
    assert find_matrix() == matrix_file
    source, found = moved
    assert found.model == "smplx"
    assert torch.equal(found.betas[0], found.betas[1])
    verts = models["smpl"].posed(source)[0].numpy()
    with open(matrix_file, "rb") as file:
        full = pickle.load(file)["mtx"].tocsr()[:, :6890]
    after = models["smplx"].posed(found)[0].numpy()
    miss = [np.linalg.norm(full @ v - w, axis=-1) for v, w in zip(verts, after, strict=True)]
    assert np.mean(miss) < 0.01


@pytest.mark.slow
def test_a_fit_of_smplx_starts_from_smpl_by_the_matrix_or_by_its_angles(
    matrix_file, moved, monkeypatch
):
    source, wanted = moved
    monkeypatch.delenv(FOLDER, raising=False)
    assert _by_matrix(source) is source
    monkeypatch.setenv(FOLDER, str(matrix_file.parents[1]))
    torch.testing.assert_close(_by_matrix(source).body_pose, wanted.body_pose)


def test_rows_of_a_matrix_are_those_of_the_file(matrix_file):
    matrix = read_matrix(matrix_file)
    with open(matrix_file, "rb") as file:
        full = pickle.load(file)["mtx"].tocsr()[:, :6890]
    some = full[np.asarray(matrix.target)].toarray()
    np.testing.assert_allclose(matrix.mix, some[:, matrix.source], atol=1e-7)
    assert np.count_nonzero(some) == int((matrix.mix != 0).sum())
    assert len(matrix.target) == 1200


def test_matrices_of_other_models_or_without_their_key_are_refused(tmp_path):
    path, shapes = official(tmp_path / "a.pkl", np.eye(5)), r"\(5, 5\).*\(10475, 6890\)"
    with pytest.raises(InputError, match=r"a\.pkl: field 'mtx' has shape " + shapes):
        read_matrix(path)
    official(tmp_path / "a.pkl", np.eye(5), key="other")
    with pytest.raises(InputError, match=r"'mtx' or 'matrix' is missing; found other"):
        read_matrix(path)


def test_a_mask_beside_the_matrix_says_which_vertices_count(matrix_file):
    mask = matrix_file.with_name("smplx_mask_ids.npy")
    np.save(mask, np.array([5, 3, 9]))
    try:
        assert read_matrix(matrix_file).target.tolist() == [3, 5, 9]
        np.save(mask, np.array([0.5]))
        with pytest.raises(InputError, match=r"smplx_mask_ids\.npy"):
            read_matrix(matrix_file)
    finally:
        mask.unlink()
