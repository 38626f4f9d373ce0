"""The noise model: its errors are those that its configuration names, and the truth stays."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from mover.bodies.skinning import open_body
from mover.core.records import fingerprint, rows_of
from mover.core.types import Capture, Detection, SceneObject
from mover.furniture.library import PIECES, make_piece
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, project, to_camera
from mover.geometry.nearest import to_surface
from mover.geometry.rle import decode
from mover.geometry.rotations import axis_angle, rot_y
from mover.geometry.topology import is_closed
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import MAKERS, add_noise, foreign_mesh, slow
from mover_bench.rooms.noise_masks import coarse, grown, leaked, wobbled

SILENT = NoiseConfig(
    along_ray=0, sideways=0, yaw=0, flips=0, scale=0, camera=0, depth_bias=0, depth_drift=0, pose=0,
    jitter=0, dropped=0, person_masks=0, missed_masks=0, object_masks=0, pose_hidden=1,
)  # fmt: skip


def noisy(tiny: KnownRoom, seed: int = 0, **errors: float) -> Capture:
    """A capture with these errors alone."""
    return add_noise(tiny, dataclasses.replace(SILENT, **errors), seed)


def shown(one: Detection) -> torch.Tensor:
    return decode(one.mask, 0)


def pairs(tiny: KnownRoom, capture: Capture) -> list[tuple[SceneObject, SceneObject]]:
    """The given and the true objects."""
    return list(zip(capture.scene.objects, tiny.truth.objects, strict=True))


def centre(piece: SceneObject) -> torch.Tensor:
    low, high = piece.mesh.verts.amin(0), piece.mesh.verts.amax(0)
    return rot_y(piece.yaw) @ ((low + high) / 2 * piece.scale) + piece.t_world_object


def size(piece: SceneObject) -> torch.Tensor:
    return (piece.mesh.verts.amax(0) - piece.mesh.verts.amin(0)) * piece.scale


def test_no_noise_gives_the_truth_back(tiny: KnownRoom) -> None:
    capture = noisy(tiny, 3)
    for given, true in pairs(tiny, capture):
        for name in ("t_world_object", "yaw", "scale"):
            assert torch.allclose(getattr(given, name), getattr(true, name), atol=1e-6)
    assert torch.allclose(capture.bodies.verts, tiny.bodies.verts, atol=5e-5)
    assert capture.people.masks.counts == tiny.capture.people.masks.counts
    assert capture.scene.ground is None


def test_noise_is_repeatable_differs_by_seed_and_leaves_the_truth(tiny: KnownRoom) -> None:
    before = fingerprint(tiny)
    first, again, other = (fingerprint(add_noise(tiny, NoiseConfig(), s)) for s in (1, 1, 2))
    assert first == again
    assert first != other
    assert fingerprint(tiny) == before


def test_a_wrong_camera_keeps_centres_in_the_camera_frame_and_projects_fronts(tiny):
    capture = noisy(tiny, camera=5.0)
    true, wrong = tiny.truth.camera.R_cam_world, capture.scene.camera.R_cam_world
    for given, piece in pairs(tiny, capture):
        assert torch.allclose(wrong @ centre(given), true @ centre(piece), atol=1e-5)
        front = true @ torch.stack([piece.yaw.sin(), torch.tensor(0.0), piece.yaw.cos()])
        x, _, z = (wrong.mT @ front).tolist()
        assert math.isclose(math.atan2(x, z), float(given.yaw), abs_tol=1e-5)
        assert torch.allclose(given.scale, piece.scale, atol=1e-6)


@pytest.mark.slow
def test_camera_errors_have_the_stated_size(tiny: KnownRoom) -> None:
    true, light = torch.stack(pitch_roll(tiny.truth.camera.R_cam_world)), _light(tiny)
    errors = []
    for seed in range(60):
        camera = noisy(light, seed, camera=3.0).scene.camera
        errors.append(torch.stack(pitch_roll(camera.R_cam_world)) - true)
        assert torch.equal(camera.K, tiny.truth.camera.K)
        assert abs(float(camera.R_cam_world[2, 0])) < 1e-6, "a guess has no heading"
    degrees = torch.stack(errors).rad2deg()
    assert float(degrees.abs().min()) > 1.99
    assert float(degrees.abs().max()) < 4.01
    assert abs(float(degrees.abs().mean()) - 3) < 0.2
    assert abs(float(degrees.mean())) < 0.9


def _light(tiny: KnownRoom) -> KnownRoom:
    """The room with one body only, for statistics over many seeds."""
    few = torch.arange(1)
    bodies = rows_of(tiny.bodies, few)
    capture = dataclasses.replace(
        tiny.capture, bodies=bodies, people=rows_of(tiny.capture.people, few)
    )
    return dataclasses.replace(tiny, bodies=bodies, capture=capture)


@pytest.mark.slow
def test_object_errors_have_the_stated_ranges_and_lie_along_the_ray(tiny: KnownRoom) -> None:
    light, along, turn = _light(tiny), [], []
    for seed in range(60):
        for given, true in pairs(tiny, noisy(light, seed, along_ray=0.3, yaw=30.0)):
            c = centre(true)
            off, ray = centre(given) - c, c / c.norm()
            assert float((off - (off @ ray) * ray).norm()) < 1e-5
            along.append(float(off @ ray))
            factor = size(given) / size(true)
            assert torch.allclose(factor, (centre(given).norm() / c.norm()).expand(3), atol=1e-5)
            turn.append(math.degrees(float(given.yaw - true.yaw)))
    assert 0.28 < max(along) <= 0.3001
    assert abs(np.std(along) - 0.3 / math.sqrt(3)) < 0.02
    turn = (np.array(turn) + 180) % 360 - 180
    assert 28 < np.abs(turn).max() <= 30.001
    assert abs(turn.std() - 30 / math.sqrt(3)) < 2


@pytest.mark.slow
def test_sizes_and_flips_follow_their_configuration(tiny: KnownRoom) -> None:
    light, factors, quarters = _light(tiny), [], []
    for seed in range(60):
        for given, true in pairs(tiny, noisy(light, seed, scale=0.15, flips=0.3)):
            factors.append(size(given) / size(true))
            turned = float(torch.remainder((given.yaw - true.yaw) / (math.pi / 2) + 0.5, 4) - 0.5)
            assert abs(turned - round(turned)) < 1e-4
            quarters.append(round(turned))
    factor = torch.stack(factors)
    assert 0.849 < float(factor.min()) < 0.86
    assert 1.14 < float(factor.max()) < 1.151
    assert abs(float(torch.corrcoef(factor.T)[0, 1])) < 0.15, "axes are independent"
    assert abs(np.mean(np.array(quarters) != 0) - 0.3) < 0.08
    assert set(quarters) == {0, 1, 2, 3}


@pytest.mark.parametrize("error", ["other_shapes", "wrong_class"])
def test_other_shapes_and_classes_fill_the_same_box(tiny: KnownRoom, error: str) -> None:
    capture = noisy(tiny, **{error: 1.0})
    for (given, true), found in zip(pairs(tiny, capture), capture.detections, strict=True):
        assert given.id == true.id
        assert torch.allclose(size(given), size(true), atol=1e-5)
        assert torch.allclose(centre(given), centre(true), atol=1e-5)
        assert found.category == given.category
        if error == "wrong_class":
            assert given.category != true.category
        else:
            assert given.mesh.verts.shape != true.mesh.verts.shape


def test_depth_bias_moves_a_body_along_its_ray_and_keeps_its_size(tiny: KnownRoom) -> None:
    bodies = noisy(tiny, 4, depth_bias=0.03).bodies
    pelvis, given = tiny.bodies.joints[:, 0], bodies.joints[:, 0]
    factor = (given / pelvis)[:, 2]
    assert torch.allclose(given, pelvis * factor[:, None], atol=1e-4)
    assert float(factor.std()) < 1e-4
    assert 0 < abs(float(factor.mean()) - 1) <= 0.0301
    moved = bodies.verts - given[:, None]
    assert torch.allclose(moved, tiny.bodies.verts - pelvis[:, None], atol=1e-4)


def test_pose_errors_turn_every_joint_by_the_stated_angle(tiny: KnownRoom) -> None:
    bodies = noisy(tiny, pose=4.0).bodies
    both = (bodies.pose, tiny.bodies.pose)
    wrong, right = (axis_angle(p.body_pose.double().reshape(-1, 21, 3)) for p in both)
    step = right.mT @ wrong
    cosine = ((step.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)
    rms = float(cosine.acos().square().mean().sqrt().rad2deg())
    assert abs(rms - 4 * math.sqrt(3)) < 0.6, "4 degrees about each of three axes"
    assert torch.allclose(open_body().posed(bodies.pose)[0], bodies.verts, atol=1e-4)


def test_slow_noise_has_variance_one_and_forgets_in_time() -> None:
    frames = np.arange(4000)
    noise = slow(np.random.default_rng(0), (frames, 0 * frames), (8,), 5.0)
    assert abs(noise.var() - 1) < 0.06
    for lag in (1, 5, 10):
        assert abs((noise[lag:] * noise[:-lag]).mean() - math.exp(-lag / 5)) < 0.06


def test_jitter_and_dropped_rows_follow_their_configuration(tiny: KnownRoom) -> None:
    bodies = noisy(tiny, 1, jitter=0.015, dropped=0.2).bodies
    kept = torch.isin(tiny.bodies.frame, bodies.frame)
    assert 0.05 < 1 - float(kept.float().mean()) < 0.35
    shift = (bodies.verts - tiny.bodies.verts[kept])[:, 0]
    assert abs(float(shift.std()) - 0.015) < 0.002
    assert len(bodies.pose.transl) == len(bodies.frame)


def test_masks_grow_and_shrink_by_whole_pixels() -> None:
    mask = np.zeros((40, 60), dtype=bool)
    mask[10:20, 15:40] = True
    for pixels in (1, 2, 3):
        big, small = grown(mask, pixels), grown(mask, -pixels)
        assert big[10 - pixels, 20]
        assert not big[10 - pixels - 1, 20]
        assert small.sum() == (10 - 2 * pixels) * (25 - 2 * pixels)
        assert (grown(mask, 0) == mask).all()


def test_people_masks_are_off_by_at_most_the_stated_pixels_and_some_are_missed(tiny):
    from scipy.ndimage import distance_transform_edt

    people, true = noisy(tiny, person_masks=3, missed_masks=0.25).people, tiny.capture.people
    assert 0.1 < 1 - len(people.frame) / len(true.frame) < 0.4
    rows = {int(f): k for k, f in enumerate(true.frame.tolist())}
    for k, frame in enumerate(people.frame.tolist()):
        a, b = decode(people.masks, k).numpy(), decode(true.masks, rows[frame]).numpy()
        extra, lost = a & ~b, b & ~a
        assert np.asarray(distance_transform_edt(~b))[extra].max(initial=0) <= 3
        assert np.asarray(distance_transform_edt(b))[lost].max(initial=0) <= 3


def test_a_leak_adds_one_disc_at_the_border(tiny: KnownRoom) -> None:
    mask = np.zeros((60, 90), dtype=bool)
    mask[20:40, 30:60] = True
    for where in (0.0, 0.4, 0.99):
        extra = leaked(mask, where) & ~mask
        assert (leaked(mask, where) | ~mask).all(), "nothing is lost"
        rows, cols = np.nonzero(extra)
        reach = 0.2 * math.sqrt(mask.sum())
        assert 0.3 * math.pi * reach**2 < extra.sum() < math.pi * reach**2
        assert max(np.ptp(rows), np.ptp(cols)) <= 2 * reach + 1
    for given, true in zip(noisy(tiny, leaks=1.0).detections, tiny.capture.detections, strict=True):
        assert shown(given).sum() > shown(true).sum()


def test_detections_and_pieces_are_missed_and_invented_together(tiny: KnownRoom) -> None:
    light = _light(tiny)
    missed = invented = 0
    for seed in range(40):
        capture = noisy(light, seed, missed=0.3, false=0.2)
        found = {d.id: d for d in capture.detections}
        assert len(found) == len(capture.detections)
        assert sorted(found) == sorted(p.annotation or 0 for p in capture.scene.objects)
        for piece in capture.scene.objects:
            one = found[piece.annotation or 0]
            assert one.category == piece.category
            assert float((one.box[2:] - one.box[:2]).min()) >= 1
        real = {p.id for p in capture.scene.objects} & {p.id for p in tiny.truth.objects}
        missed += 3 - len(real)
        invented += len(capture.scene.objects) - len(real)
        assert all(p.id in real or p.id.startswith("false_") for p in capture.scene.objects)
    assert abs(missed / 120 - 0.3) < 0.12
    assert abs(invented / (120 - missed) - 0.2) < 0.12


def test_merged_masks_are_the_union_of_two_and_one_object_is_missing(tiny: KnownRoom) -> None:
    capture = noisy(tiny, merged=1.0)
    true = {d.id: shown(d) for d in tiny.capture.detections}
    left = {d.id: shown(d) for d in capture.detections}
    assert len(left) == len(capture.detections) < len(true)
    assert {p.annotation for p in capture.scene.objects} == set(left)
    unions = torch.stack(list(left.values()))
    assert torch.equal(unions.any(0), torch.stack(list(true.values())).any(0)), "no pixel is lost"
    for mask in (true[k] for k in true if k not in left):
        assert any(bool((union & mask).sum() == mask.sum()) for union in unions)


@pytest.mark.parametrize("maker", MAKERS, ids=lambda m: m.__name__.strip("_"))
@pytest.mark.parametrize("name", ["chair", "shelf", "sofa"])
def test_a_foreign_mesh_fills_the_box_and_is_another_shape(name, maker, monkeypatch):
    monkeypatch.setattr("mover_bench.rooms.noise.MAKERS", (maker,))
    known = make_piece(name, np.random.default_rng(1), 0)
    mesh, again = (foreign_mesh(known, 0.03, np.random.default_rng(5)) for _ in range(2))
    assert torch.equal(mesh.verts, again.verts)
    found = (mesh.verts.amax(0) - mesh.verts.amin(0)).double()
    assert torch.allclose(found, torch.tensor(known.size).double(), atol=1e-4)
    away = to_surface(known.mesh.verts, mesh.verts, mesh.faces).mean()
    assert 0.005 < float(away) < 0.3


@pytest.mark.slow
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
    given = noisy(tiny, mean_bodies=True).bodies
    assert float(given.pose.betas.abs().max()) == 0

    def height(verts: torch.Tensor) -> torch.Tensor:
        pixel = project(verts, tiny.truth.camera.K)[..., 1]
        return pixel.amax(-1) - pixel.amin(-1)

    share = height(given.verts) / height(tiny.bodies.verts)
    assert 0.93 < float(share.median()) < 1.07
    assert open_body().posed(given.pose)[0].sub(given.verts).abs().max() < 1e-4


def test_a_biased_pose_stays_biased(tiny: KnownRoom) -> None:
    off = noisy(tiny, pose_bias=6.0).bodies.pose.body_pose - tiny.bodies.pose.body_pose
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
    given, true = capture.bodies.joints, tiny.bodies.joints
    assert torch.allclose(given[:, 0, 2], true[:, 0, 2] * zoom, atol=1e-3)
    assert torch.allclose(given[..., :2], true[..., :2], atol=1e-4)


def test_the_other_sets_do_not_change(tiny: KnownRoom) -> None:
    """New errors have streams of their own."""
    plain, lens = add_noise(tiny, NoiseConfig(), 3), add_noise(tiny, NoiseConfig(lens=0.05), 3)
    assert [p.yaw for p in plain.scene.objects] == [p.yaw for p in lens.scene.objects]
    assert plain.detections == lens.detections or all(
        torch.equal(a.box, b.box) for a, b in zip(plain.detections, lens.detections, strict=True)
    )
