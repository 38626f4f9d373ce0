"""Silhouettes and depth against ray casting, supersampling, analytic cases and differences.

Kernels draw in single precision, the reference in double; test_raster_warp.py compares them.
"""

import functools
import math

import numpy as np
import pytest
import raster_torch
import torch
import trimesh
from raster_torch import coverage, on_screen, signed_areas, spans
from raycast import cast, cast_backs

from mover.geometry.camera import NEAR, tilted
from mover.geometry.raster import Crops, Topology, depths, first_hit, layers, look, silhouettes
from mover.geometry.rotations import rot_y
from mover.geometry.topology import edges_of

FOCAL = 500.0


def boxes(*parts):
    made = [
        trimesh.creation.box(e, trimesh.transformations.translation_matrix(c)) for c, e in parts
    ]
    return trimesh.boolean.union(made, engine="manifold")


def chair():
    legs = [((x, 0.2, z), (0.07, 0.45, 0.07)) for x in (-0.21, 0.21) for z in (-0.21, 0.21)]
    return boxes(((0, 0.45, 0), (0.5, 0.08, 0.5)), ((0, 0.75, -0.22), (0.5, 0.6, 0.06)), *legs)


def table():
    legs = [((x, 0.3, z), (0.08, 0.75, 0.08)) for x in (-0.5, 0.5) for z in (-0.3, 0.3)]
    return boxes(((0, 0.7, 0), (1.2, 0.06, 0.8)), *legs)


def sofa():
    arms = [((x, 0.3, 0.0), (0.2, 0.6, 0.8)) for x in (-0.8, 0.8)]
    return boxes(((0, 0.2, 0), (1.7, 0.4, 0.8)), ((0, 0.5, -0.35), (1.7, 0.7, 0.15)), *arms)


SHAPES = {
    "sphere": lambda: trimesh.creation.icosphere(4, 0.6),
    "torus": lambda: trimesh.creation.torus(0.6, 0.22, major_sections=70, minor_sections=40),
    "chair": chair,
    "table": table,
    "sofa": sofa,
}


@functools.cache
def made(name):
    """Vertices, triangles and edges."""
    mesh = SHAPES[name]()
    faces = torch.tensor(np.array(mesh.faces))
    return torch.tensor(np.array(mesh.vertices)), faces, edges_of(faces)


def packed(names, extra=0, dtype=torch.float32):
    """Vertices and topology of shapes, padded to the largest and by `extra` more."""
    verts, faces, edges = zip(*map(made, names), strict=True)
    verts = [v.to(dtype) for v in verts]

    def pad(parts, fill):
        size = max(map(len, parts)) + extra
        return torch.stack([torch.cat([p, fill(p).expand(size - len(p), -1)]) for p in parts])

    zeros = lambda p: torch.zeros_like(p[:1])  # noqa: E731
    return pad(verts, lambda p: p[-1:]), Topology(pad(faces, zeros), pad(edges, zeros))


def posed(verts, params, pitch=-0.25):
    """Vertices in camera axes; params: translation 3, yaw, scale 3."""
    verts = (verts * params[..., None, 4:]) @ rot_y(params[..., 3]).mT + params[..., None, :3]
    angles = torch.tensor([pitch, 0.0]).to(verts)
    return verts @ tilted(angles[0], angles[1]).mT


def poses(starts, items, seed=0, dtype=torch.float32):
    r = torch.Generator().manual_seed(seed)
    t = torch.randn(starts, items, 3, generator=r) * 0.2 + torch.tensor([0, -0.7, -3.0])
    yaw = torch.rand(starts, items, 1, generator=r) * 2 * math.pi
    scale = 1 + 0.1 * torch.randn(starts, items, 3, generator=r)
    return torch.cat([t, yaw, scale], -1).to(dtype)


def window(verts_cam, size, margin=1.15):
    """Square windows around the items of the first start."""
    verts = verts_cam.detach().flatten(0, -4)[0] if verts_cam.ndim > 3 else verts_cam.detach()
    uv = FOCAL * verts[..., :2] / verts[..., 2:]
    low, high = uv.amin(-2), uv.amax(-2)
    side = (high - low).amax(-1) * margin
    K = torch.eye(3).to(verts).repeat(len(verts), 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = FOCAL * size / side
    K[:, :2, 2] = size / 2 - (low + high) / 2 * (size / side)[:, None]
    return Crops(K, size, size)


def supersampled(verts_cam, shape, views, by=16):
    """Coverage of each pixel by `by`² hard samples, item by item."""
    K = views.K * torch.tensor([[by], [by], [1]]).to(views.K)
    images = []
    for i, verts in enumerate(verts_cam):
        screen = on_screen(verts[None], K[i : i + 1], (views.height * by, views.width * by))
        faces = shape.faces[i].T.contiguous()
        hard = coverage(screen, spans(screen, faces, signed_areas(screen, faces) != 0))
        images.append(hard.view(views.height, by, views.width, by).float().mean((1, 3)))
    return torch.stack(images)


def slab(low, high, near, far, K, dtype=torch.float64):
    """A box seen head-on whose front fills the pixels from `low` to `high`."""
    x = [(v - K[0, 2]) / K[0, 0] * near for v in (low[0], high[0])]
    y = [(v - K[1, 2]) / K[1, 1] * near for v in (low[1], high[1])]
    mesh = trimesh.creation.box(bounds=[[x[0], y[0], near], [x[1], y[1], far]])
    faces = torch.tensor(np.array(mesh.faces))
    verts = torch.tensor(np.array(mesh.vertices), dtype=dtype)
    return verts, Topology(faces[None], edges_of(faces)[None])


def differentiable(fn, verts_cam):
    """Whether `fn` has the gradient of differences when all vertices move in random ways."""
    r = torch.Generator().manual_seed(0)
    ways = torch.randn(5, *verts_cam.shape, generator=r, dtype=verts_cam.dtype)
    still = torch.zeros(5, dtype=verts_cam.dtype, requires_grad=True)
    return torch.autograd.gradcheck(
        lambda s: fn(verts_cam + torch.tensordot(s, ways, 1)), still, eps=1e-7, atol=1e-4, rtol=1e-4
    )


PINHOLE = torch.tensor([[100.0, 0, 16], [0, 100, 16], [0, 0, 1]])


class TestSilhouettes:
    @pytest.mark.parametrize(("size", "seed"), [(128, 0), (128, 1), (256, 2)])
    def test_area_is_that_of_fine_supersampling(self, size, seed):
        verts, shape = packed(SHAPES)
        verts_cam = posed(verts, poses(1, len(verts), seed)[0])
        views = window(verts_cam, size)
        area = silhouettes(verts_cam, shape, views).sum((1, 2))
        torch.testing.assert_close(
            area, supersampled(verts_cam, shape, views).sum((1, 2)), rtol=1e-3, atol=0
        )

    @pytest.mark.parametrize("name", SHAPES)
    def test_gradient_is_that_of_supersampled_coverage(self, name):
        verts, shape = packed([name])
        params = poses(1, 1, seed=3)[0]
        views = window(posed(verts, params), 128)
        yy, xx = torch.meshgrid(*[torch.arange(128) / 128] * 2, indexing="ij")
        field = torch.sin(5 * xx + 1) * torch.cos(4 * yy) + 0.3
        free = params.clone().requires_grad_()
        (silhouettes(posed(verts, free), shape, views) * field).sum().backward()
        expected = []
        for k in range(7):
            step = torch.zeros(7)
            step[k] = 0.01
            sides = [supersampled(posed(verts, params + s * step), shape, views) for s in (1, -1)]
            expected.append(((sides[0] - sides[1]).double() * field).sum() / 0.02)
        found, expected = free.grad[0].double(), torch.stack(expected)
        assert torch.cosine_similarity(found, expected, 0) >= 0.99
        assert (found - expected).norm() <= 0.2 * expected.norm()  # steps of 2 px are coarse

    @pytest.mark.parametrize("shift", [0.0, 0.3, 0.5, 0.75])
    def test_rim_of_an_upright_rectangle_is_covered_by_its_exact_share(self, shift):
        verts, shape = slab((10 + shift, 6 + shift), (22 + shift, 20 + shift), 2.0, 2.5, PINHOLE)
        image = silhouettes(verts[None], shape, Crops(PINHOLE[None], 32, 32))[0]

        def share(low, high):
            centre = torch.arange(32, dtype=torch.float64)
            return ((centre + 1).clamp(max=high) - centre.clamp(min=low)).clamp(0, 1)

        torch.testing.assert_close(image[14], share(10 + shift, 22 + shift), atol=1e-5, rtol=0)
        torch.testing.assert_close(image[:, 16], share(6 + shift, 20 + shift), atol=1e-5, rtol=0)
        assert abs(image.sum().item() - 12 * 14) <= 1.01  # each corner pixel is off by at most 1/4

    def test_gradient_in_double_precision_is_that_of_differences(self):
        verts, shape = packed(["chair"], dtype=torch.float64)
        verts_cam = posed(verts, poses(1, 1, 4, torch.float64)[0])
        views = window(verts_cam, 20)
        assert differentiable(lambda v: silhouettes(v, shape, views), verts_cam)

    def test_window_shows_a_crop_of_the_larger_window(self):
        verts, shape = packed(["chair", "torus"])
        verts_cam = posed(verts, poses(1, 2, 5)[0])
        wide = window(verts_cam, 96)
        K = wide.K.clone()
        K[:, 0, 2] -= 40
        K[:, 1, 2] -= 25
        whole, crop = (look(verts_cam, shape, v) for v in (wide, Crops(K, 50, 33)))
        torch.testing.assert_close(crop[0], whole[0][:, 25:75, 40:73], atol=1e-3, rtol=0)
        torch.testing.assert_close(
            crop[1].nearest, whole[1].nearest[:, 25:75, 40:73], atol=1e-4, rtol=0
        )

    def test_a_sheet_of_two_triangles_has_its_own_area(self):
        verts = torch.tensor([[-0.3, -0.2, 2.0], [0.31, -0.14, 2.1], [0.04, 0.33, 1.9]])
        faces = torch.tensor([[0, 1, 2], [0, 2, 1]])
        K = PINHOLE * torch.tensor([[3.0], [3.0], [1.0]])
        uv = (verts @ K.T)[:, :2] / verts[:, 2:]
        (ax, ay), (bx, by) = (uv[1] - uv[0]).tolist(), (uv[2] - uv[0]).tolist()
        image = silhouettes(
            verts[None], Topology(faces[None], edges_of(faces)[None]), Crops(K[None], 120, 120)
        )
        assert image.sum().item() == pytest.approx(abs(ax * by - ay * bx) / 2, rel=1e-3)


class TestDepths:
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_first_and_last_surface_are_those_of_a_naive_ray_caster(self, dtype):
        verts, shape = packed(["chair", "table", "sofa"], dtype=dtype)
        verts_cam = posed(verts, poses(1, 3, 6, dtype)[0])
        views = window(verts_cam, 96)
        seen = depths(verts_cam, shape, views)
        for i in range(3):
            front, back, _, count = cast(verts_cam[i], shape.faces[i], views.K[i], 96, 96)
            covered = seen.covered[i].numpy()
            assert (covered != (count > 0)).sum() <= 2
            both = covered & (count > 0)
            np.testing.assert_allclose(seen.nearest[i].numpy()[both], front[both], atol=1e-5)
            np.testing.assert_allclose(seen.farthest[i].numpy()[both], back[both], atol=1e-5)
            assert (seen.nearest[i][~seen.covered[i]] == 0).all()
            assert (seen.farthest[i][~seen.covered[i]] == 0).all()

    @pytest.mark.parametrize("which", ["nearest", "farthest"])
    def test_gradient_is_that_of_differences(self, which):
        verts, shape = packed(["sofa"], dtype=torch.float64)
        verts_cam = posed(verts, poses(1, 1, 7, torch.float64)[0])
        views = window(verts_cam, 24)
        assert differentiable(lambda v: getattr(depths(v, shape, views), which), verts_cam)

    def test_look_gives_both_results_of_the_single_functions(self):
        verts, shape = packed(["chair", "sphere"])
        verts_cam = posed(verts, poses(2, 2, 8))
        views = window(verts_cam, 48)
        image, seen = look(verts_cam, shape, views)
        alone = depths(verts_cam, shape, views)
        assert torch.equal(image, silhouettes(verts_cam, shape, views))
        for field in ("nearest", "farthest", "covered"):
            assert torch.equal(getattr(seen, field), getattr(alone, field))
        assert look(verts_cam, shape, views, depth=False)[1] is None


class TestBatches:
    def test_padded_items_equal_single_items(self):
        names = ["chair", "sphere", "sofa"]
        verts, shape = packed(names, extra=7)
        params = poses(1, 3, 9)[0]
        views = window(posed(verts, params), 64)
        free = posed(verts, params).requires_grad_()
        image, seen = look(free, shape, views)
        (image.square().sum() + seen.nearest.square().sum()).backward()
        for i, name in enumerate(names):
            one, alone = packed([name])
            own = free.detach()[i : i + 1, : one.shape[1]].clone().requires_grad_()
            image1, seen1 = look(own, alone, Crops(views.K[i : i + 1], 64, 64))
            (image1.square().sum() + seen1.nearest.square().sum()).backward()
            torch.testing.assert_close(image[i], image1[0])
            torch.testing.assert_close(seen.farthest[i], seen1.farthest[0])
            torch.testing.assert_close(
                free.grad[i, : one.shape[1]], own.grad[0], atol=1e-2, rtol=1e-4
            )

    def test_starts_are_independent(self):
        verts, shape = packed(["chair", "table"])
        verts_cam = posed(verts, poses(6, 2, 10)).view(3, 2, 2, -1, 3).requires_grad_()
        views = window(verts_cam, 40)
        image, seen = look(verts_cam, shape, views)
        assert image.shape == seen.nearest.shape == (3, 2, 2, 40, 40)
        (image[1, 0].sum() + seen.nearest[1, 0].sum()).backward()
        touched = verts_cam.grad.abs().sum((-1, -2, -3)) > 0
        assert touched.tolist() == [[False, False], [True, False], [False, False]]
        for i in range(3):
            torch.testing.assert_close(image[i, 1], silhouettes(verts_cam[i, 1], shape, views))


class TestLayers:
    @pytest.fixture
    def bodies(self):
        """Two balls that cut into each other, as one body in three places."""
        ball = trimesh.creation.icosphere(3, 0.4)
        both = trimesh.util.concatenate([ball, ball.copy().apply_translation([0.3, 0.1, 0.35])])
        away = [[0.0, 0, -4], [9, 0, 3]]  # behind the camera, and beside the image
        places = torch.tensor([[0.0, 0, 3], [0.5, -0.3, 2.5], [-2.4, 0, 3], [0, 0.2, 0.3], *away])
        verts = torch.tensor(np.array(both.vertices), dtype=torch.float32) + places[:, None]
        K = torch.tensor([[80.0, 0, 50], [0, 80, 40], [0, 0, 1]]).repeat(len(places), 1, 1)
        return verts, torch.tensor(np.array(both.faces)), Crops(K, 80, 100)

    def test_rays_enter_and_first_leave_where_a_ray_caster_says(self, bodies):
        """Triangles that reach behind the near plane are left out, as of the fourth."""
        verts, faces, views = bodies
        found, seen = layers(verts, faces.int(), views), []
        for i in range(len(verts)):
            kept = faces[(verts[i][faces][..., 2] >= NEAR).all(-1)]
            for values, none, way in (
                (found.front[i].numpy(), np.inf, kept.flip(-1)),
                (found.exit[i].numpy(), -np.inf, kept),
            ):
                exact = cast_backs(verts[i], way, views.K[i], 80, 100)[0]
                hit, wanted = np.isfinite(values), np.isfinite(exact)
                assert (hit != wanted).sum() <= 2
                np.testing.assert_allclose(values[hit & wanted], exact[hit & wanted], atol=1e-5)
                assert (values[~hit] == none).all()
                seen.append(bool(hit.any()))
            if i < 3:
                assert torch.equal(found.front[i].isfinite(), found.exit[i].isfinite())
        assert seen == [True] * 8 + [False] * 4

    def test_nothing_to_draw_is_nothing_seen_and_precision_is_kept(self, bodies):
        verts, faces, views = bodies
        none = Crops(views.K[:0], 8, 9)
        assert layers(verts[:0], faces, none).front.shape == (0, 8, 9)
        empty = layers(verts, faces[:0], views)
        assert (empty.front == torch.inf).all()
        assert (empty.exit == -torch.inf).all()
        single, double = layers(verts, faces, views), layers(verts.double(), faces, views)
        assert torch.equal(single.front.double(), double.front)
        assert torch.equal(single.exit.double(), double.exit)

    def test_first_hit_sees_any_winding(self):
        verts, shape = packed(["chair"])
        verts_cam = posed(verts, poses(1, 1, 11)[0])
        K = window(verts_cam, 70).K[0]
        flip = torch.rand(len(shape.faces[0]), generator=torch.Generator().manual_seed(0)) < 0.5
        faces = torch.where(flip[:, None], shape.faces[0].flip(-1), shape.faces[0])
        depth, face = first_hit(verts_cam[0], faces, K, (60, 70))
        front, _, index, _ = cast(verts_cam[0], faces, K, 60, 70)
        assert ((face.numpy() >= 0) != (index >= 0)).sum() <= 2
        both = (face.numpy() >= 0) & (index >= 0)
        np.testing.assert_allclose(depth.numpy()[both], front[both], atol=1e-5)
        assert (face.numpy() != index)[both].mean() < 1e-3  # ties on edges
        assert torch.isinf(depth[face < 0]).all()

    def test_triangles_that_reach_behind_the_near_plane_are_left_out(self):
        mesh = trimesh.creation.icosphere(3, 1.0)
        verts = torch.tensor(np.array(mesh.vertices), dtype=torch.float32) + torch.tensor(
            [0.0, 0.0, 0.5]
        )
        faces = torch.tensor(np.array(mesh.faces))
        kept = faces[(verts[faces][..., 2] >= NEAR).all(-1)]
        assert 0 < len(kept) < len(faces)
        depth, face = first_hit(verts, faces, PINHOLE, (32, 32))
        front = cast(verts, kept, PINHOLE, 32, 32)[0]
        assert (face >= 0).any()
        np.testing.assert_allclose(depth.numpy(), front, rtol=1e-5)


def degenerate():
    """Names and vertices of items that must not hurt."""
    verts, shape = packed(["chair"])
    far = torch.tensor([0.0, 0, 3])
    yield "behind", verts - far, shape
    yield "around the camera", verts * 3, shape
    yield "beside the window", verts + far + torch.tensor([50.0, 0, 0]), shape
    yield "all in one point", torch.zeros_like(verts) + far, shape
    yield "flat and edge-on", verts * torch.tensor([1.0, 0.0, 1.0]) + far, shape
    yield "at the camera", torch.zeros_like(verts), shape
    yield "huge", verts * 1e6 + far, shape
    yield "astronomic", verts * 1e15 + far, shape
    yield "tiny", verts * 1e-6 + far, shape
    none = Topology(shape.faces[:, :0], shape.edges[:, :0])
    yield "without faces", verts + far, none
    yield "without faces, with padded edges", verts + far, Topology(none.faces, shape.edges * 0)
    yield "only padding", verts + far, Topology(shape.faces * 0, shape.edges * 0)
    yield "without edges", verts + far, Topology(shape.faces, none.edges)
    yield "one triangle", verts + far, Topology(shape.faces[:, :1], none.edges)


@pytest.mark.parametrize(("verts", "shape"), [pytest.param(v, s, id=n) for n, v, s in degenerate()])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_items_give_finite_values_and_gradients(verts, shape, dtype):
    free = verts.to(dtype).clone().requires_grad_()
    views = Crops(PINHOLE[None], 24, 32)
    image, seen = look(free, shape, views)
    exact, known = raster_torch.look(verts.to(dtype), shape, views)
    assert torch.equal(seen.covered, known.covered)
    drawn = (image, seen.nearest, seen.farthest)
    for values, wanted in zip(drawn, (exact, known.nearest, known.farthest), strict=True):
        torch.testing.assert_close(values.detach(), wanted, atol=1e-5, rtol=1e-5)
    sum(values.sum() for values in drawn).backward()
    assert image.dtype == seen.nearest.dtype == dtype
    assert all(torch.isfinite(values).all() for values in (*drawn, free.grad))
    assert ((image >= 0) & (image <= 1)).all()
    assert not torch.isnan(layers(free.detach(), shape.faces[0], views).front).any()
    hit = first_hit(free.detach()[0], shape.faces[0], PINHOLE, (24, 32))[1]
    assert hit.max() < shape.faces.shape[1]
    broken = free.detach().clone()
    broken[0, 0] = torch.nan
    image, seen = look(broken, shape, views)
    assert all(torch.isfinite(values).all() for values in (image, seen.nearest, seen.farthest))


def test_no_items_give_empty_images():
    verts, shape = packed(["chair"])
    none = Topology(shape.faces[:0], shape.edges[:0])
    image, seen = look(verts[:0], none, Crops(PINHOLE[None][:0], 8, 9))
    assert image.shape == seen.covered.shape == (0, 8, 9)
