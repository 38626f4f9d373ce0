"""VPoser's decoder, on random weights in the true layouts."""

import dataclasses

import pytest
import torch
from make_keypoints import CAMERA, as_bodies, seen, walker
from torch import nn

from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.fitting import STAGES, FitConfig
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.unknowns import (
    decoded,
    encoded,
    gram_schmidt,
    load_vposer,
    vectors_of,
    vposer_prior,
)
from mover.geometry.rotations import axis_angle

VERSIONS = {
    "v1": ("TR00_E096.pt", 0.2, [f"bodyprior_dec_{name}" for name in ("fc1", "fc2", "out")]),
    "v2": ("V02_05_epoch=13.ckpt", 0.01, [f"vp_model.decoder_net.{k}" for k in (0, 3, 5)]),
}
"""File, slope of the leaky ReLU and names of the layers, as the publications describe them."""
SIZES = ((512, 32), (512, 512), (126, 512))


@pytest.fixture(params=VERSIONS)
def both(request, tmp_path):
    """What the network makes of codes: two columns a joint; and the folder of its weights."""
    file, slope, names = VERSIONS[request.param]
    draw = torch.Generator().manual_seed(0)
    state = {"bodyprior_enc_fc1.weight": torch.zeros(512, 63)}  # of the encoder, which is not used
    for name, (wide, deep) in zip(names, SIZES, strict=True):
        state[f"{name}.weight"] = torch.randn(wide, deep, generator=draw) / (3 * deep) ** 0.5
        state[f"{name}.bias"] = torch.randn(wide, generator=draw) / (3 * deep) ** 0.5
    state[f"{names[2]}.weight"] *= 6  # poses of bodies, far from half turns
    state[f"{names[2]}.bias"] = torch.eye(3)[:, :2].reshape(6).repeat(21)

    def columns(z):
        for k, name in enumerate(names):
            z = z if k == 0 else nn.functional.leaky_relu(z, slope)
            z = nn.functional.linear(
                z, *(state[f"{name}.{p}"].double() for p in ("weight", "bias"))
            )
        return z.reshape(-1, 21, 3, 2)

    folder = tmp_path / "vposer" / "snapshots"
    folder.mkdir(parents=True)
    torch.save(state if request.param == "v1" else {"state_dict": state, "epoch": 3}, folder / file)
    return columns, tmp_path / "vposer"


def test_our_decoder_gives_the_rotations_of_the_network(both):
    columns_of, folder = both
    z = torch.randn(5, 32, generator=torch.Generator().manual_seed(1)).double()
    columns = columns_of(z)
    turns = decoded(load_vposer(folder), z)
    first = columns[..., 0] / columns[..., 0].norm(dim=-1, keepdim=True)
    torch.testing.assert_close(turns[..., 0], first, atol=1e-5, rtol=0)
    inside = (turns[..., 1] * columns[..., 1]).sum(-1)
    assert (inside > 0).all()
    across = (turns[..., 2] * columns[..., 1]).sum(-1)
    torch.testing.assert_close(across, 0 * across, atol=1e-5, rtol=0)
    eye = torch.eye(3).double().expand(5, 21, 3, 3)
    torch.testing.assert_close(turns @ turns.mT, eye, atol=1e-5, rtol=0)
    assert (torch.linalg.det(turns) > 0.99).all()


def test_vectors_are_the_inverse_of_rotations_with_finite_gradients():
    vector = 0.7 * torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double()
    assert vector.norm(dim=-1).max() < 3  # half a turn is the same both ways
    torch.testing.assert_close(vectors_of(axis_angle(vector)), vector, atol=1e-6, rtol=0)
    columns = torch.eye(3)[:, :2].expand(4, 3, 2).clone().requires_grad_()
    vectors_of(gram_schmidt(columns)).square().sum().backward()
    assert columns.grad.isfinite().all()


def test_codes_of_likely_poses_are_found_again(both):
    prior = vposer_prior(load_vposer(both[1]))
    code = 0.4 * torch.randn(3, 32, generator=torch.Generator().manual_seed(2))
    angles = prior.decode(code)
    again = axis_angle(prior.decode(encoded(prior, angles)).reshape(3, 21, 3))
    assert (again - axis_angle(angles.reshape(3, 21, 3))).abs().mean() < 0.05


@pytest.mark.slow
def test_a_fit_with_the_learned_prior_runs_and_only_knows_its_poses(both):
    walk = as_bodies(*walker(3))
    prior = vposer_prior(load_vposer(both[1]))
    config = FitConfig(start_steps=5, stages=(dataclasses.replace(STAGES[1], steps=10),))
    out = fit_bodies(FitInputs(seen(walk), CAMERA, open_body(), prior=prior), config)
    assert out.bodies.pose.body_pose.shape == (3, 63)
    assert out.bodies.verts.isfinite().all()


def test_files_that_are_not_vposer_are_refused(tmp_path):
    torch.save({"other.weight": torch.zeros(3)}, tmp_path / "a.pt")
    (tmp_path / "empty").mkdir()
    torch.save(nn.Linear(2, 3), tmp_path / "whole.pt")  # a pickled object, which would run code
    for name, words in (
        ("a.pt", r"a\.pt: has no 'decoder_net\.0\.weight', found other"),
        ("none.pt", "no such file, expected VPoser"),
        ("empty", "expected VPoser's snapshots"),
        ("whole.pt", r"the pickle holds torch\.nn\.modules\.linear\.Linear, expected tensors"),
    ):
        with pytest.raises(InputError, match=words):
            load_vposer(tmp_path / name)
