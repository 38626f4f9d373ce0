"""The Warp rasteriser against the torch rasteriser, itself, and input that must not hurt."""

import subprocess
import sys

import pytest
import raster_torch
import torch
import trimesh
from reference import use_threads
from test_raster import PINHOLE, packed, posed, poses, slab, window

from mover.geometry import raster
from mover.geometry import raster as raster_warp
from mover.geometry.raster import Crops, Topology
from mover.geometry.warp_start import _cores, threads

wp = pytest.importorskip("warp")
NAMES = ["sphere", "torus", "chair", "table", "sofa"]


def scene(names=NAMES, size=96, seed=0, starts=1):
    """Vertices in camera axes, topology and windows of some shapes."""
    verts, shape = packed(names, extra=5)
    verts_cam = posed(verts, poses(starts, len(names), seed))
    return verts_cam if starts > 1 else verts_cam[0], shape, window(verts_cam, size)


def pulled(drawer, verts_cam, shape, views, seed=0):
    """Silhouette, depths and the gradient of a random mean of all of them."""
    free = verts_cam.clone().requires_grad_()
    image, seen = drawer.look(free, shape, views)
    r = torch.Generator().manual_seed(seed)
    maps = (image, seen.nearest, seen.farthest)
    weights = [torch.randn(image.shape, generator=r).to(image) for _ in maps]
    sum((m * w).sum() for m, w in zip(maps, weights, strict=True)).backward()
    return image.detach(), seen.nearest.detach(), seen.farthest.detach(), seen.covered, free.grad


class TestAgreement:
    @pytest.mark.parametrize("seed", [0, 1, 2])
    @pytest.mark.parametrize("size", [33, 128])
    def test_depths_and_gradients_are_those_of_torch_in_double_precision(self, size, seed):
        verts_cam, shape, views = scene(size=size, seed=seed)
        found = pulled(raster_warp, verts_cam, shape, views)
        exact = pulled(raster_torch, verts_cam.double(), shape, views)
        assert torch.equal(found[3], exact[3])
        for values, truth in zip(found[1:3], exact[1:3], strict=True):
            torch.testing.assert_close(values.double(), truth, atol=1e-5, rtol=0)
        for mine, truth in zip(found[4], exact[4], strict=True):
            assert (mine - truth).norm() <= 1e-3 * truth.norm()

    def test_silhouettes_have_the_bits_of_torch(self):
        verts_cam, shape, views = scene(size=150, starts=3)
        image = raster_warp.look(verts_cam, shape, views, depth=False)[0]
        assert torch.equal(image, raster_torch.look(verts_cam, shape, views, depth=False)[0])

    @pytest.mark.parametrize("shift", [0.0, 0.5, 1e-6])
    def test_edges_through_pixel_centres_are_decided_as_by_torch(self, shift):
        """Both test centres with the same operations, so not even a tie may differ."""
        verts, shape = slab((9.5 + shift, 5.5), (21.5, 20.5 + shift), 2.0, 2.5, PINHOLE)
        views = Crops(PINHOLE[None], 32, 32)
        verts = verts[None].float()
        found, truth = (pulled(r, verts, shape, views) for r in (raster_warp, raster_torch))
        assert torch.equal(found[0], truth[0])
        assert torch.equal(found[3], truth[3])
        torch.testing.assert_close(found[4], truth[4], atol=1e-3, rtol=1e-3)

    def test_parts_too_long_to_count_are_drawn_one_after_the_other(self, monkeypatch):
        verts_cam, shape, views = scene(["chair", "sphere"], 40, starts=3)
        whole = pulled(raster_warp, verts_cam, shape, views)
        monkeypatch.setattr(raster_warp, "MOST", 1)
        for part, expected in zip(pulled(raster_warp, verts_cam, shape, views), whole, strict=True):
            assert torch.equal(part, expected)

    def test_numbers_of_vertices_may_be_short(self):
        verts_cam, shape, views = scene(["table"], 50)
        short = Topology(shape.faces.int(), shape.edges.int())
        assert torch.equal(
            raster_warp.look(verts_cam, short, views)[0],
            raster_warp.look(verts_cam, shape, views)[0],
        )


class TestRepetition:
    def test_any_number_of_threads_gives_the_same_bits(self):
        verts_cam, shape, views = scene(size=128, starts=2)
        runs = []
        for count in (1, 2, 3, 2):
            with use_threads(count):
                runs.append(pulled(raster_warp, verts_cam, shape, views))
        for run in runs[1:]:
            for values, expected in zip(run, runs[0], strict=True):
                assert torch.equal(values, expected)

    def test_working_memory_is_left_clean_for_smaller_and_larger_windows(self):
        inputs = [scene(NAMES[i:], size) for i, size in enumerate((64, 128, 31))]
        alone = []
        for args in inputs:
            alone.append(pulled(raster_warp, *args))
        for args, expected in zip(inputs, alone, strict=True):
            for values, truth in zip(pulled(raster_warp, *args), expected, strict=True):
                assert torch.equal(values, truth)


class TestBadInput:
    """Beside that of `test_raster.degenerate`."""

    def test_a_window_of_4k_is_drawn(self):
        verts_cam, shape, views = scene(["chair"], 2160)
        K = views.K + torch.tensor([[0, 0, 840.0], [0, 0, 0], [0, 0, 0]])
        image, seen = raster_warp.look(verts_cam, shape, Crops(K, 2160, 3840))
        small = raster_warp.look(verts_cam, shape, scene(["chair"], 216)[2])[0]
        assert image.sum().item() == pytest.approx(100 * small.sum().item(), rel=0.01)
        assert torch.isfinite(seen.nearest).all()

    @pytest.mark.slow
    def test_half_a_million_faces_are_drawn(self):
        mesh = trimesh.creation.icosphere(8, 0.6)
        while len(mesh.faces) < 500_000:
            mesh = mesh.subdivide()
        faces = torch.tensor(mesh.faces)[None]
        verts = torch.tensor(mesh.vertices, dtype=torch.float32)[None] + torch.tensor([0, 0, 3.0])
        shape = Topology(faces, torch.zeros(1, 0, 4, dtype=torch.int64))
        free = verts.requires_grad_()
        image, seen = raster_warp.look(free, shape, window(verts, 256))
        (image.sum() + seen.nearest.sum()).backward()
        assert torch.isfinite(free.grad).all()
        assert seen.nearest.max() < 3.01


class TestEngine:
    @pytest.mark.parametrize(("asked", "count"), [("3", 3), ("0", None), ("many", None)])
    def test_threads_are_those_of_openmp_else_one_a_core(self, asked, count, monkeypatch):
        monkeypatch.setenv("OMP_NUM_THREADS", asked)
        assert threads() == (count or _cores())
        with use_threads(5):
            assert threads() == 5

    def test_double_precision_is_drawn_in_single_and_handed_back(self, monkeypatch):
        monkeypatch.setattr(raster, "_reference_of", lambda _: None)
        verts_cam, shape, views = scene(["sphere"], 24)
        free, same = (v.clone().requires_grad_() for v in (verts_cam.double(), verts_cam))
        (image, seen), (single, _) = (raster_warp.look(v, shape, views) for v in (free, same))
        assert image.dtype == seen.nearest.dtype == torch.float64
        assert torch.equal(image, single.double())
        image.square().sum().backward()
        single.square().sum().backward()
        assert torch.equal(free.grad, same.grad.double())

    def test_intrinsics_that_ask_for_a_gradient_are_refused(self):
        verts_cam, shape, views = scene(["sphere"], 24)
        with pytest.raises(ValueError, match="no gradient"):
            raster_warp.look(verts_cam, shape, Crops(views.K.clone().requires_grad_(), 24, 24))

    @pytest.mark.slow
    def test_drawing_says_nothing(self):
        code = (
            "import torch; from mover.geometry.raster import *;"
            "e = torch.zeros(1, 0, 4).long(); f = torch.tensor([[[0, 1, 2]]]);"
            "v = torch.tensor([[[0., 0, 2], [0, 1, 2], [1, 0, 2]]]);"
            "K = torch.tensor([[[9., 0, 8], [0, 9, 8], [0, 0, 1]]]);"
            "assert look(v, Topology(f, e), Crops(K, 16, 16))[0].sum() > 5"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
