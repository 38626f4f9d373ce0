"""A moving camera: its scale from people at rest, masks seen from another position."""

import dataclasses
from pathlib import Path

import little_room
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mover.bodies.parts import parts_of
from mover.core.run import Run
from mover.core.types import STILL, Bodies, CameraPath, Capture
from mover.extensions.moving_camera import (
    ScaleInputs,
    bodies_as_given,
    find_scale,
    with_metric_path,
)
from mover.geometry.camera import to_camera
from mover.geometry.path import from_reference, poses_at, resampled, scaled, to_reference
from mover.pipeline.people import carried
from mover.pipeline.presets import PRESETS

FRAMES, FPS = 200, 5.0
CAMERA = little_room.camera()
SPOTS = torch.tensor([[-1.0, -3.0], [0.8, -4.0], [1.2, -2.8], [-0.4, -4.6]])


def swaying(amount: float = 0.6) -> CameraPath:
    """A camera that sways sideways and looks at the same place [m]."""
    way = np.arange(FRAMES) / FPS
    x = amount * np.sin(way / 3)
    turn = Rotation.from_rotvec(np.stack([0 * x, -x / 4, 0.02 * np.sin(way)], 1)).as_matrix()
    t = np.stack([x, 0.1 * x**2, 0.2 * x], 1)
    return CameraPath(
        torch.arange(FRAMES), torch.from_numpy(turn).float(), torch.from_numpy(t).float()
    )


def staying(noise: float = 0.0) -> Bodies:
    """A person who stays at one spot after the other and walks between, about the reference."""
    walker = little_room.walkers(1)
    stay = torch.arange(FRAMES) / FRAMES * len(SPOTS)
    spot, share = stay.floor().long(), ((stay - stay.floor()) * 4 - 3).clamp_min(0)[:, None]
    place = torch.lerp(SPOTS[spot], SPOTS[(spot + 1) % len(SPOTS)], share)
    feet = torch.stack([place[:, 0], torch.full((FRAMES,), little_room.GROUND), place[:, 1]], -1)
    verts = walker.verts - walker.verts[0].mean(0) * torch.tensor([1.0, 0, 1]) * 1.0
    verts = verts - verts[..., 1].min() * torch.tensor([0.0, 1, 0]) + feet[:, None]
    random = torch.Generator().manual_seed(1)
    verts = verts + noise * torch.randn(FRAMES, 1, 3, generator=random)
    frame, person = torch.arange(FRAMES), torch.zeros(FRAMES, dtype=torch.long)
    return Bodies(
        to_camera(verts, CAMERA.R_cam_world), walker.faces, None, (), frame, person, FPS,
        "camera", None,
    )  # fmt: skip


def seen_by(path: CameraPath, bodies: Bodies) -> Bodies:
    """The same people in the axes of the moving camera."""
    return dataclasses.replace(
        bodies, verts=from_reference(bodies.verts, poses_at(path, bodies.frame))
    )


@pytest.mark.parametrize(("noise", "within"), [(0.0, 1e-3), (0.01, 0.02)])
@pytest.mark.parametrize("units", [0.1, 1.0, 7.0])
def test_people_at_rest_give_the_scale_in_any_units(noise, within, units) -> None:
    path = swaying()
    bodies = seen_by(path, staying(noise))
    parts = parts_of(bodies, CAMERA.R_cam_world[:, 1])
    found = find_scale(ScaleInputs(bodies, parts, scaled(path, units)))
    assert found.scale * units == pytest.approx(1, abs=within)
    assert abs(found.scale * units - 1) < 4 * found.spread + 1e-3
    assert found.warnings == ()


def test_people_who_are_all_too_far_make_the_path_longer_by_as_much() -> None:
    path = swaying()
    bodies = seen_by(path, staying())
    farther = dataclasses.replace(bodies, verts=1.1 * bodies.verts)
    parts = parts_of(bodies, CAMERA.R_cam_world[:, 1])
    found = find_scale(ScaleInputs(farther, parts, path))
    assert found.scale == pytest.approx(1.1, rel=1e-3)


def test_too_few_frames_are_reported() -> None:
    path = swaying()
    bodies = seen_by(path, staying())
    few = dataclasses.replace(
        bodies, verts=bodies.verts[:3], frame=bodies.frame[:3], person=bodies.person[:3]
    )
    found = find_scale(ScaleInputs(few, parts_of(few, CAMERA.R_cam_world[:, 1]), path))
    assert "too few frames" in found.warnings[0]


@pytest.mark.parametrize("path", ["find", "keep"])
def test_a_capture_gets_its_path_in_metres_unless_it_is_so(path: str, tmp_path: Path) -> None:
    bodies, given = staying(), scaled(swaying(), 7.0)
    capture = Capture(
        "room", dataclasses.replace(little_room.room(), objects=()), None, (), None, None,
        seen_by(swaying(), bodies), None, None, ("odd",), path=given,
    )  # fmt: skip
    config = dataclasses.replace(PRESETS["robust"], path=path)
    found = with_metric_path(capture, config, Run(tmp_path))
    assert found.warnings == ("odd",)
    if path == "keep":
        assert found is capture
        return
    assert torch.allclose(found.path.t_reference_camera, swaying().t_reference_camera, atol=2e-3)
    assert torch.allclose(bodies_as_given(capture).verts, bodies.verts, atol=5e-3)
    still = dataclasses.replace(capture, path=STILL)
    assert with_metric_path(still, config, Run(tmp_path)) is still
    assert bodies_as_given(still) is still.bodies


def test_people_are_carried_back_to_where_they_stood() -> None:
    path, bodies = swaying(), staying()
    assert torch.allclose(carried(seen_by(path, bodies), path).verts, bodies.verts, atol=1e-5)
    assert carried(bodies, STILL) is bodies


def test_a_mask_is_looked_up_where_the_other_camera_sees_the_surface() -> None:
    """A naive loop over pixels."""
    K = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    random = torch.Generator().manual_seed(2)
    image = torch.rand(2, 32, 48, generator=random) > 0.5
    depth = 2 + torch.rand(32, 48, generator=random)
    window = (slice(4, 28), slice(10, 44))
    pose = poses_at(swaying(), torch.tensor([20]))
    found = resampled(image, depth[window], (K, window), pose)
    for y in range(4, 28, 5):
        for x in range(10, 44, 7):
            ray = torch.linalg.inv(K) @ torch.tensor([x + 0.5, y + 0.5, 1.0])
            there = from_reference((ray * depth[y, x])[None, None], pose)[0, 0]
            u, v = ((K @ there)[:2] / there[2]).floor().long().tolist()
            inside = 0 <= u < 48 and 0 <= v < 32
            expected = image[:, v, u] if inside else torch.zeros(2, dtype=torch.bool)
            assert torch.equal(found[:, y - 4, x - 10], expected)


def test_a_still_camera_looks_up_its_own_pixels() -> None:
    K = torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
    image = torch.rand(1, 32, 48, generator=torch.Generator().manual_seed(3)) > 0.5
    window = (slice(0, 32), slice(0, 48))
    assert torch.equal(resampled(image, torch.full((32, 48), 3.0), (K, window), STILL), image)
    points = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(3))
    assert torch.equal(to_reference(points, poses_at(STILL, torch.arange(3))), points)
