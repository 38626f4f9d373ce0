"""What furniture may hide of people, in the frames of a still and of a moving camera."""

import dataclasses

import little_room
import numpy as np
import pytest
import torch
from jaxtyping import Bool
from scipy.spatial.transform import Rotation
from test_find_depth import QUICK, SIZE, K, film, masks_of, moved, spots
from test_find_depth import inputs_of as depth_inputs
from torch import Tensor

from mover.core.types import STILL, CameraPath, Capture, Detection, Masks, People
from mover.geometry.camera import to_camera
from mover.geometry.path import from_reference, poses_at
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.stages.cover import Cover, covered, hiding
from mover.stages.people.find_depth import find_depth

FRAME = 33
FRAMES, EVERY = 60, 6
CAMERA, ROOM = little_room.camera(), little_room.room()
BODIES = [to_camera(place_object(o).verts, CAMERA.R_cam_world) for o in ROOM.objects]


def path_of(amount: float) -> CameraPath:
    """A camera that sways."""
    way = np.linspace(0, 1, FRAMES)[:, None]
    t = amount * np.sin(way * [7, 5, 6])
    R = Rotation.from_rotvec(amount * np.sin(way * [4, -5, 3]) / 6).as_matrix()
    return CameraPath(
        torch.arange(FRAMES), torch.from_numpy(R).float(), torch.from_numpy(t).float()
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


def filmed(path: CameraPath) -> Capture:
    """The little room with masks of its furniture in some frames."""
    detections = tuple(
        Detection(k + 1, "table", tight_box(mask), Masks(*mask.shape, (encode(mask),)), 1.0)
        for k, mask in enumerate(seen(path, 0))
    )
    rows, codes = [], []
    for frame in range(EVERY, FRAMES, EVERY):
        masks = seen(path, frame)
        rows += [(frame, k + 1) for k in range(len(masks))]
        codes += [encode(mask) for mask in masks]
    frame, number = torch.tensor(rows).unbind(1)
    furniture = People(Masks(CAMERA.height, CAMERA.width, tuple(codes)), frame, number, {})
    pieces = tuple(dataclasses.replace(o, annotation=k + 1) for k, o in enumerate(ROOM.objects))
    scene = dataclasses.replace(ROOM, objects=pieces, camera=CAMERA)
    bare = Capture("room", scene, None, detections, None, None, None, None, None, ())
    return dataclasses.replace(bare, furniture=furniture, path=path)


def missed(found: Bool[Tensor, "h w"], true: Bool[Tensor, "h w"]) -> tuple[float, float]:
    """Shares of the furniture that is not covered, and of what is covered and is none."""
    whole = float(true.sum())
    return float((true & ~found).sum()) / whole, float((found & ~true).sum()) / whole


def test_a_still_camera_has_the_masks_of_the_reference_image_in_all_frames() -> None:
    capture = filmed(path_of(0.3))
    found = covered(hiding(capture, STILL))
    whole = torch.stack(seen(STILL, 0)).any(0)
    assert torch.equal(found(0), whole)
    assert torch.equal(found(FRAME), whole)


@pytest.mark.parametrize("views", [True, False])
def test_furniture_is_covered_where_the_moving_camera_sees_it(views: bool) -> None:
    path = path_of(0.3)
    capture = filmed(path)
    if not views:
        capture = dataclasses.replace(capture, furniture=None)
    found = covered(hiding(capture, path))
    true = torch.stack(seen(path, FRAME)).any(0)
    lost, more = missed(found(FRAME), true)
    assert lost < 0.03
    assert more < (0.15 if views else 0.5)
    assert missed(torch.stack(seen(path, 0)).any(0), true)[0] > 0.1  # had it stood still


def test_without_furniture_nothing_is_covered() -> None:
    path = path_of(0.3)
    capture = dataclasses.replace(filmed(path), detections=(), furniture=None)
    assert not covered(hiding(capture, path))(FRAME).any()


def test_furniture_before_people_of_a_turned_camera_is_not_taken_for_their_depth() -> None:
    """Masks of people whose legs are hidden are no smaller because they are far away."""
    true, turn = film(spots(12)), torch.eye(3)
    turn[0, 2], turn[2, 0] = 0.1, -0.1  # it looks 52 pixels to the right
    path = CameraPath(torch.arange(2), torch.stack([torch.eye(3), turn]), torch.zeros(2, 3))
    here, reference = (torch.zeros(SIZE, dtype=torch.bool) for _ in range(2))
    here[230:, 100:480] = True
    reference[230:, 152:532] = True
    inputs = depth_inputs(moved(true, 1.03), masks_of(true, hidden=here))
    later = inputs.people.frame + 1
    bodies, people = (dataclasses.replace(x, frame=later) for x in (inputs.bodies, inputs.people))
    inputs = dataclasses.replace(inputs, bodies=bodies, people=people)
    code, one = Masks(*SIZE, (encode(reference),)), torch.ones(1)
    cover = Cover(code, one.long(), 3.0 * one, STILL, path, K)
    known, bare = (
        float(find_depth(dataclasses.replace(inputs, objects=c), QUICK).factor[0]) - 1 / 1.03
        for c in (cover, Cover(Masks(*SIZE, ())))
    )
    assert abs(known) < 0.004
    assert abs(bare) > 0.005
