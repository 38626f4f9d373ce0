"""What furniture may hide of people, in the frames of a still and of a moving camera."""

import dataclasses

import pytest
import torch
from jaxtyping import Bool
from test_align_views import CAMERA, ROOM, inputs_of, path_of, seen
from test_find_depth import (
    QUICK,
    SIZE,
    K,
    film,
    masks_of,
    moved,
    spots,
)
from test_find_depth import inputs_of as depth_inputs
from torch import Tensor

from mover.core.types import STILL, CameraPath, Capture, Masks
from mover.geometry.rle import encode
from mover.stages.cover import Cover, covered, hiding
from mover.stages.people.find_depth import find_depth

FRAME = 33


def filmed(path: CameraPath) -> Capture:
    """The little room with masks of its furniture in some frames."""
    known = inputs_of(path, path)
    pieces = tuple(dataclasses.replace(o, annotation=k + 1) for k, o in enumerate(ROOM.objects))
    scene = dataclasses.replace(ROOM, objects=pieces, camera=CAMERA)
    bare = Capture("room", scene, None, known.detections, None, None, None, None, None, ())
    return dataclasses.replace(bare, furniture=known.furniture, path=path)


def missed(found: Bool[Tensor, "h w"], true: Bool[Tensor, "h w"]) -> tuple[float, float]:
    """Shares of the furniture that is not covered, and of what is covered and is none."""
    whole = float(true.sum())
    return float((true & ~found).sum()) / whole, float((found & ~true).sum()) / whole


def test_a_still_camera_has_the_masks_of_the_reference_image_in_all_frames() -> None:
    capture = filmed(path_of(0.3, 0.0, 0.0))
    found = covered(hiding(capture, STILL))
    whole = torch.stack(seen(STILL, 0)).any(0)
    assert torch.equal(found(0), whole)
    assert torch.equal(found(FRAME), whole)


@pytest.mark.parametrize("views", [True, False])
def test_furniture_is_covered_where_the_moving_camera_sees_it(views: bool) -> None:
    path = path_of(0.3, 0.0, 0.0)
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
    path = path_of(0.3, 0.0, 0.0)
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
    inputs = dataclasses.replace(
        inputs,
        bodies=dataclasses.replace(inputs.bodies, frame=later),
        people=dataclasses.replace(inputs.people, frame=later),
    )
    code, one = Masks(*SIZE, (encode(reference),)), torch.ones(1)
    cover = Cover(code, one.long(), 3.0 * one, STILL, path, K)
    known, bare = (
        float(find_depth(dataclasses.replace(inputs, objects=c), QUICK).factor[0]) - 1 / 1.03
        for c in (cover, Cover(Masks(*SIZE, ())))
    )
    assert abs(known) < 0.004
    assert abs(bare) > 0.005
