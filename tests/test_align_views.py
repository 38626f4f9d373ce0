"""Furniture that is segmented in further frames tells how a moving camera's path has drifted."""

import dataclasses

import little_room
import numpy as np
import pytest
import torch
from jaxtyping import Bool
from scipy.spatial.transform import Rotation
from torch import Tensor

from mover.core.types import CameraPath, Detection, Masks, People
from mover.geometry.camera import to_camera
from mover.geometry.path import from_reference, poses_at
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.geometry.rotations import rotation_vectors
from mover.stages.camera.align_views import ViewInputs, align_views, aligned

FRAMES, EVERY = 60, 6
CAMERA, ROOM = little_room.camera(), little_room.room()
BODIES = [to_camera(place_object(o).verts, CAMERA.R_cam_world) for o in ROOM.objects]


def path_of(amount: float, drift: float, turn: float) -> CameraPath:
    """A camera that sways; at the end it is off by a drift [m] and a turn [rad]."""
    way = np.linspace(0, 1, FRAMES)[:, None]
    t = amount * np.sin(way * [7, 5, 6]) + drift * way * [0.6, -0.8, 0]
    look = amount * np.sin(way * [4, -5, 3]) / 6
    R = Rotation.from_rotvec(look) * Rotation.from_rotvec(turn * way * [0.8, 0.6, 0])
    first = np.arange(FRAMES)
    return CameraPath(
        torch.from_numpy(first),
        torch.from_numpy(R.as_matrix()).float(),
        torch.from_numpy(t).float(),
    )


def seen(path: CameraPath, frame: int) -> list[Bool[Tensor, "h w"]]:
    """The visible mask of each object."""
    pose = poses_at(path, torch.tensor([frame]))
    verts = from_reference(torch.cat(BODIES)[None], pose)[0]
    counts = [0, *np.cumsum([len(b) for b in BODIES]).tolist()]
    faces = torch.cat([o.mesh.faces + counts[k] for k, o in enumerate(ROOM.objects)])
    owner = torch.cat([torch.full((len(o.mesh.faces),), k) for k, o in enumerate(ROOM.objects)])
    _, face = first_hit(verts, faces, CAMERA.K, (CAMERA.height, CAMERA.width))
    return [(face >= 0) & (owner[face.clamp_min(0)] == k) for k in range(len(BODIES))]


def inputs_of(true: CameraPath, given: CameraPath) -> ViewInputs:
    """Masks as the true path sees them; depths are first guesses, up to a tenth wrong."""
    found = tuple(
        Detection(k + 1, "table", tight_box(mask), Masks(*mask.shape, (encode(mask),)), 1.0)
        for k, mask in enumerate(seen(true, 0))
    )
    rows, codes = [], []
    for frame in range(EVERY, FRAMES, EVERY):
        masks = seen(true, frame)
        rows += [(frame, k + 1) for k in range(len(masks))]
        codes += [encode(mask) for mask in masks]
    frame, number = torch.tensor(rows).unbind(1)
    masks = Masks(CAMERA.height, CAMERA.width, tuple(codes))
    furniture = People(masks, frame, number, {})
    depth = torch.stack([b[:, 2].mean() for b in BODIES]) * torch.tensor([1.1, 0.95, 1.05])
    return ViewInputs(CAMERA, found, depth, furniture, None, given)


def off(path: CameraPath, true: CameraPath) -> tuple[float, float]:
    """Mean error of the place [m] and of the direction [rad]."""
    turn = rotation_vectors(path.R_reference_camera.mT @ true.R_reference_camera)
    shift = path.t_reference_camera - true.t_reference_camera
    return float(shift.norm(dim=-1).mean()), float(turn.norm(dim=-1).mean())


@pytest.fixture(scope="module")
def drifting() -> ViewInputs:
    return inputs_of(path_of(0.3, 0.0, 0.0), path_of(0.3, 0.06, 0.02))


def test_furniture_in_further_frames_takes_most_of_the_drift_away(drifting: ViewInputs) -> None:
    true = path_of(0.3, 0.0, 0.0)
    views = align_views(drifting)
    place, turn = off(aligned(drifting.path, views), true)
    first = off(drifting.path, true)
    assert place < 0.35 * first[0], (place, first)
    assert turn < 0.35 * first[1], (turn, first)
    assert views.shift[0].norm() < 1e-4
    assert views.turn[0].norm() < 1e-4
    assert "corrected by up to" in views.warnings[0]


def test_a_true_path_stays_as_it_is() -> None:
    true = path_of(0.3, 0.0, 0.0)
    views = align_views(inputs_of(true, true))
    place, turn = off(aligned(true, views), true)
    assert place < 0.01
    assert turn < 0.002
    assert views.warnings == ()


def test_a_wrong_mask_in_a_view_has_no_say(drifting: ViewInputs) -> None:
    true = path_of(0.3, 0.0, 0.0)
    wrong = drifting.furniture.masks.counts
    spoilt = (*wrong[:4], wrong[5], wrong[4], *wrong[6:])  # a sofa and a table are mistaken
    masks = dataclasses.replace(drifting.furniture.masks, counts=spoilt)
    furniture = dataclasses.replace(drifting.furniture, masks=masks)
    views = align_views(dataclasses.replace(drifting, furniture=furniture))
    good = off(aligned(drifting.path, align_views(drifting)), true)
    place, turn = off(aligned(drifting.path, views), true)
    assert place < good[0] + 0.01
    assert turn < good[1] + 0.002


def test_views_without_a_free_side_leave_the_path_alone(drifting: ViewInputs) -> None:
    full = torch.ones(CAMERA.height, CAMERA.width, dtype=torch.bool)
    frames = drifting.furniture.frame.unique()
    masks = Masks(*full.shape, (encode(full),) * len(frames))
    crowd = People(masks, frames, torch.zeros_like(frames), {})
    views = align_views(dataclasses.replace(drifting, people=crowd))
    found = aligned(drifting.path, views)
    assert torch.equal(found.t_reference_camera, drifting.path.t_reference_camera)
    assert torch.equal(found.R_reference_camera, drifting.path.R_reference_camera)
