"""Shapes whose outlines do not fit are down-weighted beside people."""

from dataclasses import replace

import pytest
import torch
from analytic import FACES
from test_refine_bodies import GROUND, QUICK, SEATED, room_with, seat_gap, still_people

from mover.core.types import Capture, Detection, Masks, Room
from mover.energy.body_terms import Sighting, bounds_of_skin, order_term
from mover.geometry.camera import project, to_camera
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode
from mover.stages.people.body_evidence import shape_uncertainty
from mover.stages.people.refine_bodies import refine_bodies


def test_a_shape_is_uncertain_as_far_as_its_outline_does_not_fit():
    """Of two objects one fits its mask, in part hidden by the other, which does not."""
    masks, drawn = torch.zeros(2, 10, 20, dtype=torch.bool), torch.full((10, 20), -1)
    masks[0, :, :8], masks[1, :, 8:13] = True, True
    drawn[:, :8], drawn[:, 8:18] = 0, 1
    share = shape_uncertainty(drawn, masks)
    assert share.tolist() == pytest.approx([0.0, 0.2 * (0.5 - 0.1)])
    drawn[:, 5:8] = 1  # what another object occludes does not count
    assert float(shape_uncertainty(drawn, masks)[0]) == 0
    assert shape_uncertainty(drawn, torch.zeros(2, 10, 20, dtype=torch.bool)).tolist() == [0, 0]


def test_what_may_end_elsewhere_hides_and_is_hidden_as_much_more_loosely():
    front, yes = torch.full((2, 30), 3.0), torch.ones(2, 30, dtype=torch.bool)
    for depth, seen in ((front + 0.5, (yes, ~yes)), (front - 0.5, (~yes, yes))):
        known = bounds_of_skin(Sighting(front, *seen, yes, torch.full_like(front, 0.6)))
        assert (order_term(depth, known) == 0).all()
        assert (order_term(2 * depth - front, known) > 1).all()


def seen_as(room: Room, share: float) -> Capture:
    """What was seen of a room of one box, whose mask ends at a share of the width it has."""
    camera = room.scene.camera
    verts = to_camera(place_object(room.scene.objects[0]).verts, camera.R_cam_world)
    drawn = first_hit(verts.contiguous(), FACES, camera.K, (camera.height, camera.width))[1] >= 0
    x = drawn.any(0).nonzero()[:, 0].float()
    mask = drawn & (torch.arange(camera.width) < x.min() + share * (x.max() + 1 - x.min()))
    pixels = project(verts, camera.K)
    box = torch.cat([pixels.amin(0), pixels.amax(0)])
    found = Masks(camera.height, camera.width, (encode(mask),))
    seen = Detection(0, "stool", box, found, 1.0)
    piece = replace(room.scene.objects[0], annotation=0)
    scene = replace(room.scene, objects=(piece,))
    return Capture("room", scene, None, (seen,), None, None, None, None, None, ())


@pytest.mark.slow
def test_a_sitter_is_not_lifted_by_a_seat_whose_shape_does_not_fit():
    """As fitted to a few millimetres; of a shape that fits the seat itself is trusted."""
    sitter = still_people(SEATED, 3)
    height = float(seat_gap(sitter, 0.0)[0]) + 0.06
    room = room_with(sitter, ((0.6, height, 0.6), (0.0, GROUND, -3.1)))
    moves = [
        float((refine_bodies(room, seen_as(room, share), QUICK).bodies.verts - sitter.verts)
              [..., 1].mean())
        for share in (1.0, 0.4)
    ]  # fmt: skip
    assert moves[0] > 0.03  # of 6 cm
    assert abs(moves[1]) < 0.01
