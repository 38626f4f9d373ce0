"""The failure cases of the paper are said: nothing below a sitter, hidden legs, a wrong seat."""

from dataclasses import replace

import pytest
import torch
from analytic import make_inputs
from figures import SEATED, people, pose

from mover.bodies.parts import parts_of
from mover.core.types import Masks, People
from mover.geometry.rle import encode
from mover.stages.contacts.diagnostics import DiagnosticInputs, diagnostics


def inputs_with(seated, touches=None, masks=None):
    room = make_inputs(size=16)
    bodies = people(pose(SEATED, 6), fps=5.0)
    layout = replace(
        room.starts, t_world_object=room.starts.t_world_object[0], yaw=room.starts.yaw[0],
        log_scale=room.starts.log_scale[0],
    )  # fmt: skip
    return DiagnosticInputs(
        bodies, parts_of(bodies), masks, room.camera, room.objects, layout, touches,
        torch.full((6,), seated),
    )  # fmt: skip


def test_a_seated_person_on_nothing_is_named():
    (text,) = diagnostics(inputs_with(seated=False))
    assert "person 0 sits on nothing in 6 bodies" in text
    assert "missing" in text


def test_a_seated_person_on_something_gives_no_warning():
    assert diagnostics(inputs_with(seated=True)) == ()


@pytest.mark.parametrize(("lift", "side"), [(0.2, "above"), (-0.2, "below")])
def test_a_seat_of_another_height_than_its_sitters_is_named(lift, side):
    touches = make_inputs(size=16).humans.touches
    moved = replace(touches, points=touches.points + torch.tensor([0.0, lift, 0.0]))
    (text,) = diagnostics(inputs_with(seated=True, touches=moved))
    assert text.startswith("stool: its sitters touch 20 cm " + side)


def test_hidden_legs_are_named():
    blank = encode(torch.zeros(360, 640, dtype=torch.bool))
    rows = torch.arange(6)
    masks = People(Masks(360, 640, (blank,) * 6), rows, torch.zeros(6, dtype=torch.long), {})
    found = inputs_with(seated=True, masks=masks)
    many = replace(
        found, bodies=replace(found.bodies, verts=found.bodies.verts.repeat(3, 1, 1),
                              frame=torch.arange(18), person=torch.zeros(18, dtype=torch.long),
                              pose=None),
        people=People(Masks(360, 640, (blank,) * 18), torch.arange(18),
                      torch.zeros(18, dtype=torch.long), {}),
        seated_on=torch.ones(18, dtype=torch.bool),
    )  # fmt: skip
    (text,) = diagnostics(many)
    assert "lower body of person 0 is hidden" in text
