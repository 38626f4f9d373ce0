"""The set `upstream`: what today's tools give, all errors at once."""

import numpy as np
import pytest
import torch
from test_noise import noisy, pairs, posed, shown, size

from mover.bodies.skinning import open_body
from mover.core.types import SceneObject
from mover.furniture.library import PIECES, make_piece
from mover.geometry.boxes import box_of
from mover.geometry.camera import project, to_camera
from mover.geometry.nearest import to_surface
from mover.geometry.topology import is_closed
from mover_bench.rooms import foreign
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.foreign import MAKERS, foreign_mesh
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.noise_masks import coarse, wobbled


@pytest.mark.parametrize("maker", MAKERS, ids=lambda m: m.__name__.strip("_"))
@pytest.mark.parametrize("name", ["chair", "shelf", "sofa"])
def test_a_foreign_mesh_fills_the_box_and_is_another_shape(name, maker, monkeypatch):
    monkeypatch.setattr(foreign, "MAKERS", (maker,))
    known = make_piece(name, np.random.default_rng(1), 0)
    mesh, again = (foreign_mesh(known, 0.03, np.random.default_rng(5)) for _ in range(2))
    assert torch.equal(mesh.verts, again.verts)
    found = (mesh.verts.amax(0) - mesh.verts.amin(0)).double()
    assert torch.allclose(found, torch.tensor(known.size).double(), atol=1e-4)
    away = to_surface(known.mesh.verts, mesh.verts, mesh.faces).mean()
    assert 0.005 < float(away) < 0.3


def test_every_piece_has_foreign_meshes_and_most_are_open_or_unclean() -> None:
    meshes = [
        foreign_mesh(make_piece(name, np.random.default_rng(k)), 0.03, np.random.default_rng(k))
        for k, name in enumerate(PIECES)
    ]
    assert sum(is_closed(mesh.faces) for mesh in meshes) < len(meshes) / 2


def test_a_mask_head_keeps_what_is_large_and_loses_what_is_thin() -> None:
    mask = np.zeros((200, 300), dtype=bool)
    mask[50:150, 60:240] = True
    mask[20:50, 100:103] = True
    drawn = coarse(mask, np.array([60.0, 20.0, 240.0, 150.0]), 28)
    assert (drawn & mask).sum() / (drawn | mask).sum() > 0.9
    assert drawn[20:45, 100:103].mean() < 0.5
    assert not drawn[:, :55].any()


def test_an_outline_wobbles_by_the_stated_pixels() -> None:
    mask = np.zeros((200, 300), dtype=bool)
    mask[40:160, 50:250] = True
    off = [
        wobbled(mask, 2.5, np.random.default_rng(seed))[60:140].argmax(1) - 50.0
        for seed in range(40)
    ]  # an island before the outline counts as the outline: a little more than 2.5
    assert 2.0 < np.std(off) < 4.0
    assert abs(np.mean(off)) < 1.0


def test_amodal_masks_hold_what_is_hidden(tiny: KnownRoom) -> None:
    both = zip(noisy(tiny, amodal=1.0).detections, tiny.capture.detections, strict=True)
    grown = [int(shown(a).sum()) - int(shown(b).sum()) for a, b in both]
    assert min(grown) >= 0
    assert max(grown) > 0


def test_mean_bodies_have_one_shape_and_fill_their_pictures(tiny: KnownRoom) -> None:
    given, _, pose = posed(noisy(tiny, mean_bodies=True).bodies)
    assert float(pose.betas.abs().max()) == 0

    def height(verts: torch.Tensor) -> torch.Tensor:
        pixel = project(verts, tiny.truth.camera.K)[..., 1]
        return pixel.amax(-1) - pixel.amin(-1)

    share = height(given.verts) / height(tiny.bodies.verts)
    assert 0.93 < float(share.median()) < 1.07
    assert open_body().posed(pose)[0].sub(given.verts).abs().max() < 1e-4


def test_a_biased_pose_stays_biased(tiny: KnownRoom) -> None:
    given, true = (posed(b)[2] for b in (noisy(tiny, pose_bias=6.0).bodies, tiny.bodies))
    off = given.body_pose - true.body_pose
    assert float(off.mean(0).abs().mean()) > 3 * float(off.std(0).median())


@pytest.mark.parametrize("seed", range(4))
def test_a_wrong_lens_keeps_the_picture_and_the_widths(tiny: KnownRoom, seed: int) -> None:
    capture = noisy(tiny, seed, lens=0.055)
    zoom = float(capture.scene.camera.K[0, 0] / tiny.truth.camera.K[0, 0])
    assert 0.029 < abs(zoom - 1) < 0.081

    def seen(piece: SceneObject, K: torch.Tensor) -> torch.Tensor:
        return project(to_camera(box_of(piece).center, tiny.truth.camera.R_cam_world), K)

    for given, true in pairs(tiny, capture):
        assert torch.allclose(size(given), size(true), atol=1e-5)
        pixels = seen(given, capture.scene.camera.K), seen(true, tiny.truth.camera.K)
        assert torch.allclose(*pixels, atol=0.05)
    given, true = (posed(b)[1] for b in (capture.bodies, tiny.bodies))
    assert torch.allclose(given[:, 0, 2], true[:, 0, 2] * zoom, atol=1e-3)
    assert torch.allclose(given[..., :2], true[..., :2], atol=1e-4)


def test_the_other_sets_do_not_change(tiny: KnownRoom) -> None:
    """New errors have streams of their own."""
    plain, lens = add_noise(tiny, NoiseConfig(), 3), add_noise(tiny, NoiseConfig(lens=0.05), 3)
    assert [p.yaw for p in plain.scene.objects] == [p.yaw for p in lens.scene.objects]
    assert plain.detections == lens.detections or all(
        torch.equal(a.box, b.box) for a, b in zip(plain.detections, lens.detections, strict=True)
    )
