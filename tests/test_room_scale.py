"""How large the room is: by its furniture, by how high people sit."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import boxes_of
from figures import ARMS_DOWN, SEATED, people, pose
from test_given import somewhere

from mover.bodies.parts import parts_of
from mover.core.types import Layout
from mover.energy.prior_terms import COMMON, SIZE
from mover.stages.objects.gather_given import gather_given
from mover.stages.objects.room_scale import (
    FITTED,
    ScaleKnown,
    _cost_of_sizes,
    common_scale,
    seat_height_estimate,
)

ROOM = 0.0


@pytest.mark.parametrize("large", [0.93, 1.0, 1.06])
def test_furniture_tells_how_large_the_room_is(large: float) -> None:
    """Sizes and places are given with errors; under people too large all is too large at once."""
    generator = torch.Generator().manual_seed(1)
    count = 9
    objects = boxes_of(("aquarium",) * count, [(1.0, 0.8, 0.6)] * count)
    true = replace(somewhere(count), t_world_object=somewhere(count).t_world_object * 1.2)
    error = 0.04 * torch.randn(count, 1, generator=generator)
    start = replace(true, t_world_object=true.t_world_object * error.exp())
    off = error + 0.08 * torch.randn(count, 3, generator=generator)
    found = Layout(true.t_world_object * large, true.yaw, math.log(large) - off)
    given = gather_given(objects, start, found, torch.full((count,), 0.1))
    scale, spread = common_scale(found, given, ScaleKnown(0.055))
    assert abs(scale - math.log(large)) < 0.03
    assert 0.01 < spread < 0.03
    assert common_scale(found, given, ScaleKnown(0.0)) == (0, 0)
    assert abs(common_scale(found, given, ScaleKnown(0.005))[0]) < 0.006
    (same, near), (less, far), (none, nothing) = (
        common_scale(found, given, ScaleKnown(0.055, off)) for off in (0.01, 0.04, 5.0)
    )
    assert spread < near < far < nothing == pytest.approx(0.055, rel=0.02)
    assert same == pytest.approx(scale, abs=0.005)
    assert abs(none) < 1e-3
    assert min(0.0, scale) <= less <= max(0.0, scale)  # what was given may be off together
    metres = Layout(found.t_world_object.clone(), found.yaw, found.log_scale)
    metres.t_world_object[0] *= 1.8
    assert abs(common_scale(metres, given, ScaleKnown(0.055))[0] - scale) < 0.015


def test_what_sizes_cost_is_the_least_squares_of_all_that_is_said_of_them() -> None:
    """Each size is said by the tool, by the standard, and by the image, with their errors."""
    torch.manual_seed(2)
    objects = boxes_of(
        ("table", "chair", "aquarium"), [(1.2, 0.7, 0.7), (0.5, 0.9, 0.5), (1, 1, 1)]
    )
    layout = somewhere(3)
    layout = replace(layout, log_scale=0.1 * torch.randn(3, 3))
    given = gather_given(objects, layout, layout, torch.full((3,), 0.1))
    scales = torch.tensor([-0.04, 0.0, 0.07]).double()
    offs = torch.tensor([-0.05, 0.0, 0.02]).double()
    found = _cost_of_sizes(layout, given, scales, offs)
    eye = torch.eye(3).double()
    for i, scale in enumerate(scales):
        for j, off in enumerate(offs):
            total = 0.0
            for n in range(3):
                usual = given.precision[n] > 0
                design = torch.cat([eye, eye, eye[usual]])
                said = torch.cat([
                    off.expand(3), layout.log_scale[n].double() - scale,
                    given.standard[n][usual].double(),
                ])  # fmt: skip
                noise = torch.block_diag(
                    SIZE**2 * eye + COMMON**2, FITTED**2 * eye,
                    torch.diag(1 / given.precision[n][usual].double()),
                )  # fmt: skip
                white = torch.linalg.inv(torch.linalg.cholesky(noise))
                best = torch.linalg.lstsq(white @ design, (white @ said)[:, None]).solution
                total += 0.5 * float((white @ (said - design @ best[:, 0])).square().sum())
            assert float(found[i, j]) == pytest.approx(total, rel=1e-6)


@pytest.mark.parametrize("large", [0.94, 1.0, 1.05])
def test_who_sits_as_high_as_people_do_tells_their_size(large: float) -> None:
    sitters = people(pose(SEATED, 5), fps=5.0)
    high = replace(sitters, verts=large * sitters.verts)
    usual, found = (seat_height_estimate(b, parts_of(b), ROOM) for b in (sitters, high))
    assert usual is not None
    assert found is not None
    assert abs(usual[0]) < 2 * usual[1]  # the open body on its own soles
    assert found[0] - usual[0] == pytest.approx(math.log(large), abs=1e-4)
    layout = somewhere(1)
    given = gather_given(boxes_of(("aquarium",), [(1.0, 1.0, 1.0)]), layout, layout, torch.ones(1))
    told = [
        common_scale(layout, given, ScaleKnown(0.055, seats=seats))[0]
        for seats in (None, (0.05, 0.06), (0.05, 0.001))
    ]
    assert told[0] == pytest.approx(0, abs=1e-3)
    assert told[0] < told[1] < told[2] == pytest.approx(0.05, abs=1e-3)


def test_who_stands_or_sits_on_the_floor_tells_nothing() -> None:
    standing = people(pose(ARMS_DOWN, 5), fps=5.0)
    assert seat_height_estimate(standing, parts_of(standing), ROOM) is None
    once = people(pose(SEATED, 2), fps=5.0)
    assert seat_height_estimate(once, parts_of(once), ROOM) is None  # too few to say


def test_more_seat_height_estimate_more() -> None:
    sitters = people(pose(SEATED, 12), fps=5.0)
    moved = sitters.verts.clone()
    moved[6:, :, 0] += 1.0
    two = replace(sitters, verts=moved)
    one, both = (seat_height_estimate(b, parts_of(b), ROOM) for b in (sitters, two))
    assert one is not None
    assert both is not None
    assert both[0] == pytest.approx(one[0], abs=1e-4)
    assert both[1] < one[1]
