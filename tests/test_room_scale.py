"""How large the room is: by its furniture, by how high people sit."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import boxes_of
from figures import ARMS_DOWN, SEATED, people, pose
from test_given import somewhere
from test_pipeline import light

from mover.bodies.parts import parts_of
from mover.core.run import Run
from mover.core.types import Layout
from mover.pipeline.reconstruct import reconstruct
from mover.stages.objects.gather_given import gather_given
from mover.stages.objects.room_scale import (
    DISTANCES,
    TOOL,
    ScaleKnown,
    common_scale,
    seat_height_estimate,
)

ROOM = 0.0


@pytest.mark.parametrize("large", [0.93, 1.0, 1.06])
def test_furniture_shows_how_large_the_room_is(large: float) -> None:
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
    kinds = objects.categories
    free, _ = common_scale(found, given, kinds, ScaleKnown((0.0, 1.0)))
    scale, spread = common_scale(found, given, kinds, ScaleKnown((0.0, 0.055)))
    assert abs(scale - math.log(large)) < 0.03
    assert scale == pytest.approx((1 - (spread / 0.055) ** 2) * free, abs=0.002)
    assert 0.01 < spread < 0.04  # of .055: what one tool gave is off together
    assert common_scale(found, given, kinds, ScaleKnown((0.0, 0.0))) == (0, 0)
    assert abs(common_scale(found, given, kinds, ScaleKnown((0.0, 0.005)))[0]) < 0.006
    (same, near), (less, far), (none, nothing) = (
        common_scale(found, given, kinds, ScaleKnown((0.0, 0.055), off))
        for off in (0.01, 0.04, 5.0)
    )
    assert spread < near < far < nothing == pytest.approx(0.055, rel=0.02)
    assert same == pytest.approx(scale, abs=0.005)
    assert abs(none) < 1e-3
    assert min(0.0, scale) <= less <= max(0.0, scale)  # what was given may be off together
    metres = Layout(found.t_world_object.clone(), found.yaw, found.log_scale)
    metres.t_world_object[0] *= 1.8
    assert abs(common_scale(metres, given, kinds, ScaleKnown((0.0, 0.055)))[0] - scale) < 0.015


def test_objects_that_err_together_count_as_few() -> None:
    """A hundred given distances and sizes of one tool leave what all of them share."""
    spreads, scales = [], []
    for count in (4, 100):
        objects = boxes_of(("chair",) * count, [(0.5, 0.9, 0.5)] * count)
        layout = somewhere(count)
        given = gather_given(objects, layout, layout, torch.full((count,), 0.1))
        larger = replace(layout, t_world_object=1.1 * layout.t_world_object)
        scale, spread = common_scale(larger, given, objects.categories, ScaleKnown((0.0, 1.0)))
        spreads.append(spread)
        scales.append(scale)
    assert (DISTANCES**-2 + TOOL**-2) ** -0.5 / 2 < spreads[1] < spreads[0]
    assert all(0 < scale < math.log(1.1) for scale in scales)  # sizes say that nothing is larger


@pytest.mark.parametrize("large", [0.94, 1.0, 1.05])
def test_the_height_of_sitters_gives_their_size(large: float) -> None:
    sitters = people(pose(SEATED, 5), fps=5.0)
    high = replace(sitters, verts=large * sitters.verts)
    usual, found = (seat_height_estimate(b, parts_of(b), ROOM) for b in (sitters, high))
    assert abs(usual[0]) < 2 * usual[1]  # the open body on its own soles
    assert found[0] - usual[0] == pytest.approx(math.log(large), abs=1e-4)
    layout = somewhere(1)
    given = gather_given(boxes_of(("aquarium",), [(1.0, 1.0, 1.0)]), layout, layout, torch.ones(1))
    scales = [
        common_scale(layout, given, ("aquarium",), ScaleKnown((0.0, 0.055), seats=seats))[0]
        for seats in (None, (0.05, 0.06), (0.05, 0.001))
    ]
    assert scales[0] == pytest.approx(0, abs=1e-3)
    assert scales[0] < scales[1] < scales[2] == pytest.approx(0.05, abs=1e-3)


def test_standing_people_and_few_sitters_give_no_size() -> None:
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
    assert both[0] == pytest.approx(one[0], abs=1e-4)
    assert both[1] < one[1]
    moved[6:] *= 1.3  # seats differ more than they usually do
    assert seat_height_estimate(two, parts_of(sitters), ROOM)[1] > both[1]


@pytest.mark.slow
def test_a_room_of_people_of_unknown_height_says_how_uncertain_it_is(small_capture, tmp_path):
    unknown = replace(small_capture, bodies=replace(small_capture.bodies, size_spread=0.06))
    given = [
        [w for w in reconstruct(capture, light("robust"), Run(tmp_path)).warnings if "heights" in w]
        for capture in (small_capture, unknown)
    ]
    assert given[0] == []
    (warning,) = given[1]
    assert "uncertain by" in warning
    assert "--height" in warning
