"""VPoser's decoder, on random weights in the true layouts."""

import dataclasses

import pytest
import torch
from make_keypoints import CAMERA, as_bodies, seen, walker
from torch import nn

from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import STAGES, FitConfig
from mover.fitting.prior import (
    decoded,
    encoded,
    gram_schmidt,
    load_vposer,
    vectors_of,
    vposer_prior,
)
from mover.geometry.rotations import axis_angle


class First(nn.Module):
    """The first version's network, as its publication describes it."""

    def __init__(self):
        super().__init__()
        self.bodyprior_enc_bn1 = nn.BatchNorm1d(63)
        self.bodyprior_enc_fc1 = nn.Linear(63, 512)
        self.bodyprior_enc_bn2 = nn.BatchNorm1d(512)
        self.bodyprior_enc_fc2 = nn.Linear(512, 512)
        self.bodyprior_enc_mu, self.bodyprior_enc_logvar = nn.Linear(512, 32), nn.Linear(512, 32)
        self.bodyprior_dec_fc1 = nn.Linear(32, 512)
        self.bodyprior_dec_fc2 = nn.Linear(512, 512)
        self.bodyprior_dec_out = nn.Linear(512, 126)

    def forward(self, z):
        x = nn.functional.leaky_relu(self.bodyprior_dec_fc1(z), 0.2)
        x = nn.functional.leaky_relu(self.bodyprior_dec_fc2(x), 0.2)
        return self.bodyprior_dec_out(x)


class Second(nn.Module):
    """The second version's: a decoder in a row."""

    def __init__(self):
        super().__init__()
        self.vp_model = nn.ModuleDict({"decoder_net": nn.Sequential(
            nn.Linear(32, 512), nn.LeakyReLU(), nn.Dropout(0.1), nn.Linear(512, 512),
            nn.LeakyReLU(), nn.Linear(512, 126),
        )})  # fmt: skip

    def forward(self, z):
        return self.vp_model["decoder_net"](z)


@pytest.fixture(params=["v1", "v2"])
def both(request, tmp_path):
    torch.manual_seed(0)
    net = (First() if request.param == "v1" else Second()).eval()
    last = net.bodyprior_dec_out if request.param == "v1" else net.vp_model["decoder_net"][5]
    with torch.no_grad():  # poses of bodies, far from half turns
        last.weight.mul_(6)
        last.bias.copy_(torch.eye(3)[:, :2].reshape(6).repeat(21))
    folder = tmp_path / "vposer" / "snapshots"
    folder.mkdir(parents=True)
    if request.param == "v1":
        torch.save(net.state_dict(), folder / "TR00_E096.pt")
    else:
        state = {"state_dict": net.state_dict(), "epoch": 3}
        torch.save(state, folder / "V02_05_epoch=13.ckpt")
    return net, tmp_path / "vposer"


def test_our_decoder_gives_the_rotations_of_the_network(both):
    net, folder = both
    z = torch.randn(5, 32, generator=torch.Generator().manual_seed(1)).double()
    columns = net.double()(z).detach().reshape(5, 21, 3, 2)
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
    torch.save(First(), tmp_path / "whole.pt")  # a pickled object, which would run code
    for name, words in (
        ("a.pt", r"a\.pt: has no 'decoder_net\.0\.weight', found other"),
        ("none.pt", "does not exist"),
        ("empty", "expected VPoser's snapshots"),
        ("whole.pt", "cannot be read as plain weights"),
    ):
        with pytest.raises(InputError, match=words):
            load_vposer(tmp_path / name)
