"""Furniture runs as its own straight edges do, whatever the shape of its mesh."""

import math
from pathlib import Path

import pytest
import torch
from analytic import box_verts
from torch import Tensor

from mover.core.types import Camera, Heading
from mover.geometry.camera import project, tilted, to_camera
from mover.geometry.rotations import rot_y
from mover.io.capture.folder import read_capture
from mover.stages.camera.room_lines import SURE, Segments, find_segments
from mover.stages.objects.find_image_cues import image_evidence
from mover.stages.objects.gather_given import given_axis
from mover.stages.objects.own_edges import own_edges

PHOTO = Path(__file__).parents[2] / "shared/data/photo_bench"
K = torch.tensor([[800.0, 0, 480], [0, 800, 270], [0, 0, 1]])
PAIRS = [(a, b) for a in range(8) for b in range(a + 1, 8)]
WALLS = Heading(0.0, math.radians(0.5))


def camera(pitch: float = 0.25, roll: float = 0.04) -> Camera:
    R = tilted(torch.tensor(pitch), torch.tensor(roll))
    return Camera(K=K, R_cam_world=R, width=960, height=540)


def ends_of(yaw: float, at: tuple[float, float, float], view: Camera) -> Tensor:
    """Both ends of the twelve edges of a box, as the camera sees them [px]."""
    box = box_verts((1.2, 0.6, 0.8)).double()
    edges = [(a, b) for a, b in PAIRS if int((box[a] != box[b]).sum()) == 1]
    verts = box @ rot_y(torch.tensor(yaw).double()).mT + torch.tensor(at).double()
    pixels = project(to_camera(verts[None], view.R_cam_world.double())[0], view.K.double())
    return pixels[torch.tensor(edges)]


def segments_of(ends: Tensor, error: float = 1e-3) -> Segments:
    along = torch.nn.functional.normalize(ends[:, 1] - ends[:, 0], dim=-1)
    one = torch.ones(len(ends), dtype=torch.float64)
    return Segments(ends.mean(1) - K[:2, 2].double(), along, error * one, one, one.long())


EVERYWHERE = torch.ones(1, 540, 960, dtype=torch.bool)
NOWHERE = torch.zeros(540, 960, dtype=torch.bool)


def off(yaw: Tensor, true: float) -> Tensor:
    """From the nearest quarter turn [rad]."""
    quarter = math.pi / 2
    return torch.remainder(yaw - true + quarter / 2, quarter) - quarter / 2


@pytest.mark.parametrize("yaw", [0.0, 0.3, 0.7, 1.0, -0.5])
@pytest.mark.parametrize("pitch", [0.1, 0.35])
def test_level_edges_of_a_box_give_its_yaw_and_upright_ones_nothing(yaw: float, pitch: float):
    view = camera(pitch)
    ends = ends_of(yaw, (0.9, -1.4, -4.0), view)
    found = own_edges(segments_of(ends), EVERYWHERE, NOWHERE, view)
    assert len(found.yaw) == 8
    torch.testing.assert_close(off(found.yaw, yaw), torch.zeros(8), atol=1e-4, rtol=0)


def test_level_edges_that_look_upright_are_left_out():
    view = camera()
    ends = ends_of(1.2, (0.9, -1.4, -4.0), view)  # one side points nearly at the camera
    found = own_edges(segments_of(ends), EVERYWHERE, NOWHERE, view)
    assert len(found.yaw) == 7
    torch.testing.assert_close(off(found.yaw, 1.2), torch.zeros(7), atol=1e-4, rtol=0)


def test_edges_are_as_uncertain_as_they_are_when_their_angles_err():
    view, generator = camera(), torch.Generator().manual_seed(3)
    ends = ends_of(0.5, (0.9, -1.4, -4.0), view)
    error = 0.004
    exact = segments_of(ends, error)
    stated = own_edges(exact, EVERYWHERE, NOWHERE, view)
    rolled = []
    for _ in range(400):
        turn = error * torch.randn(len(ends), generator=generator, dtype=torch.float64)
        x, y = exact.along.unbind(-1)
        along = torch.stack([turn.cos() * x - turn.sin() * y, turn.sin() * x + turn.cos() * y], -1)
        noisy = Segments(exact.middle, along, exact.error, exact.vote, exact.group)
        rolled.append(off(own_edges(noisy, EVERYWHERE, NOWHERE, view).yaw, 0.5))
    spread = torch.stack(rolled).square().mean(0).sqrt()
    torch.testing.assert_close(stated.spread, spread, atol=0, rtol=0.15)


def test_an_edge_belongs_to_the_one_thing_whose_mask_it_is_in_and_not_to_people():
    view = camera()
    ends = torch.tensor(
        [[[100.0, 300], [160, 310]], [[300, 300], [360, 310]], [[500, 300], [560, 310]],
         [[700, 300], [760, 310]], [[200, 400], [260, 410]]]
    ).double()  # fmt: skip
    masks, people = torch.zeros(2, 540, 960, dtype=torch.bool), NOWHERE.clone()
    masks[0, 280:320, 100:340] = True  # the first, the second
    masks[1, 280:320, 320:540] = True  # the second, the third
    masks[1, 280:304, 700:760] = True  # the fourth is its outline
    people[280:320, 520:560] = True
    found = own_edges(segments_of(ends), masks, people, view)
    assert found.of.tolist() == [0, 1]
    alone = own_edges(segments_of(ends[[0, 3]]), masks, people, view)
    torch.testing.assert_close(found.yaw, alone.yaw)


def test_of_things_whose_edges_agree_their_own_axis_counts_else_the_rooms():
    view, left = camera(), (-0.9, -1.4, -4.0)
    ends = ends_of(0.6, left, view)
    masks = torch.zeros(2, 540, 960, dtype=torch.bool)
    masks[0, :, :480], masks[1, :, 480:] = True, True
    slanted = torch.tensor([[[600.0, 200], [650, 260]], [[700, 400], [740, 380]],
                            [[800, 300], [860, 302]]]).double()  # fmt: skip
    both = segments_of(torch.cat([ends, slanted]), 0.004)
    edges = own_edges(both, masks, NOWHERE, view)
    assert set(edges.of.tolist()) == {0, 1}
    given = given_axis(("chair", "chair"), WALLS, edges)
    room = given_axis(("chair", "chair"), WALLS)
    assert float(off(given.axis[0], 0.6).abs()) < math.radians(0.5)
    assert float(given.along[0]) > float(room.along[0])
    assert float(given.sharpness[0]) > float(room.sharpness[0])
    for name in ("axis", "along", "sharpness"):
        assert getattr(given, name)[1] == getattr(room, name)[1]


def test_one_edge_that_the_room_contradicts_is_outvoted():
    view = camera()
    one = segments_of(ends_of(0.6, (0.9, -1.4, -4.0), view)[:1], 0.02)
    edges = own_edges(one, EVERYWHERE, NOWHERE, view)
    given, room = given_axis(("bed",), WALLS, edges), given_axis(("bed",), WALLS)
    assert given.axis.tolist() == room.axis.tolist()


@pytest.mark.skipif(not PHOTO.exists(), reason="no photograph here")
def test_the_slats_of_a_photographed_bench_agree():
    capture = read_capture(PHOTO)
    view, seen = capture.scene.camera, image_evidence(capture)
    segments = find_segments(capture.reference, seen.people, view.K[:2, 2], SURE)
    edges = own_edges(segments, seen.masks, seen.people, view)
    assert len(edges.yaw) >= 5
    middle = edges.yaw[(edges.yaw - edges.yaw.median()).abs().argsort()[:5]]
    assert float(middle.max() - middle.min()) < math.radians(15)
