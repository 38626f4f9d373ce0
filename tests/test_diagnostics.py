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


def inputs_with(seated, touches=None, masks=None, count=6):
    room, bodies = make_inputs(size=16), people(pose(SEATED, count), fps=5.0)
    return DiagnosticInputs(
        bodies, parts_of(bodies), masks, room.camera, room.objects, room.starts[0], touches,
        torch.full((count,), seated),
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
    rows = torch.arange(18)
    masks = People(Masks(360, 640, (blank,) * 18), rows, 0 * rows, {})
    (text,) = diagnostics(inputs_with(seated=True, masks=masks, count=18))
    assert "lower body of person 0 is hidden" in text
