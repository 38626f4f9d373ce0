"""The preset `release`: the rules of the authors' code that change numbers, without its bugs."""

from dataclasses import replace

import pytest
import torch
from analytic import make_inputs

from mover.core.types import Layout
from mover.energy.terms.contact import contact_term
from mover.energy.terms.depth import DepthRange, depth_term
from mover.energy.terms.factors import factors
from mover.energy.terms.silhouette import edge_term
from mover.geometry.placement import place
from mover.pipeline.presets import RELEASE
from mover.stages.config import ReinitConfig
from mover.stages.objects.place_objects import bounded, unbounded
from mover.stages.objects.starts import ReinitInputs, by_release


def renamed(inputs, *categories):
    return replace(inputs.objects, categories=categories)


def test_used_chairs_and_sofas_are_spared_by_depth_and_collision():
    inputs = make_inputs(size=16)
    found = factors(renamed(inputs, "chair", "sofa", "table"), inputs.humans.touches, "release")
    assert found.depth.tolist() == pytest.approx([0.3, 0.01, 1.0])
    assert found.collision.tolist() == pytest.approx([0.1, 2.0, 1.0])


def test_paper_spares_nobody():
    inputs = make_inputs(size=16)
    found = factors(renamed(inputs, "chair", "sofa", "table"), inputs.humans.touches, "paper")
    assert found.depth.tolist() == found.collision.tolist() == [1, 1, 1]


def test_the_sigmoid_of_scales_is_inverted_with_its_denominator():
    scale = torch.tensor([1.0, 0.8]).log()[None, :, None].expand(1, 2, 3)
    layout = Layout(torch.zeros(1, 2, 3), torch.zeros(1, 2), scale)
    span = torch.tensor([0.8, 0.6])
    back = bounded(unbounded(layout, span), span)
    torch.testing.assert_close(back.log_scale, layout.log_scale)
    wild = replace(layout, log_scale=torch.full((1, 2, 3), 9.0))
    assert bounded(wild, span).log_scale.exp().amax((0, 2)).tolist() == pytest.approx(
        [1.4, 1.3], abs=1e-3
    )


def reinit(inputs, categories):
    layout = replace(
        inputs.starts, t_world_object=inputs.starts.t_world_object[0], yaw=inputs.starts.yaw[0],
        log_scale=inputs.starts.log_scale[0],
    )  # fmt: skip
    seats = ReinitInputs(
        renamed(inputs, *categories), inputs.camera, inputs.humans, inputs.image.masks, layout
    )
    return layout, by_release(seats, ReinitConfig(use=True))


def test_a_used_chair_goes_to_its_contacts_and_faces_as_its_sitters():
    inputs = make_inputs(size=16)
    touches = inputs.humans.touches
    moved = replace(touches, points=touches.points + torch.tensor([0.3, 0.0, 0.2]))
    turned = replace(moved, heading=torch.tensor([[1.0, 0.0], [0.0, 1.0]]))
    inputs = replace(inputs, humans=replace(inputs.humans, touches=turned))
    before, after = reinit(inputs, ("chair", "table", "cabinet"))
    step = after.t_world_object[0] - before.t_world_object[0]
    torch.testing.assert_close(step, torch.tensor([0.3, 0.0, 0.2]), atol=1e-4, rtol=0)
    assert float(after.yaw[0]) == pytest.approx(torch.pi / 2, abs=1e-5)
    far = after.t_world_object[0, [0, 2]].norm() / before.t_world_object[0, [0, 2]].norm()
    torch.testing.assert_close(after.log_scale[0].exp(), far.expand(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(after.t_world_object[1:], before.t_world_object[1:])


def test_a_chair_that_is_where_its_contacts_are_keeps_its_size():
    _, after = reinit(make_inputs(size=16), ("chair", "table", "cabinet"))
    torch.testing.assert_close(after.log_scale[0], torch.zeros(3), atol=1e-4, rtol=0)


def test_contact_runs_from_the_object_to_the_body_and_is_a_mean():
    inputs = make_inputs(torch.float64, size=16)
    top, back = (place(p, inputs.starts) for p in (inputs.objects.top, inputs.objects.back))
    lifted = top + torch.tensor([0.0, 0.25, 0.0], dtype=torch.float64)
    found = contact_term((lifted, back), inputs.humans.touches, "release")[0]
    assert found.tolist() == pytest.approx([0.25, 0.25, 0.0], abs=1e-4)


def test_the_far_bound_acts_on_the_back_and_is_clamped():
    from mover.geometry.raster import Depths

    covered = torch.ones(1, 1, 8, 8, dtype=torch.bool)
    seen = Depths(torch.full((1, 1, 8, 8), 2.0), torch.full((1, 1, 8, 8), 9.0), covered)
    mask, none = torch.ones(1, 8, 8), torch.full((1, 8, 8), float("-inf"))
    allowed = DepthRange(none, torch.full((1, 8, 8), 3.0), none, torch.ones(1))
    assert float(depth_term(seen, mask, allowed, "release")) == 64 * 2.0
    assert float(depth_term(seen, mask, allowed, "paper")) == 0.0


def test_the_edge_term_counts_the_ring_outside_by_the_root_of_its_distance():
    mask = torch.zeros(1, 32, 32)
    mask[0, 8:16, 8:16] = 1
    shifted = mask.roll(5, -1)[None]
    keep = torch.ones(1, 32, 32, dtype=torch.bool)
    same, off = edge_term(mask[None], mask, keep), edge_term(shifted, mask, keep)
    assert float(same) == 0.0
    assert float(off) > 10.0


def test_the_preset_has_the_numbers_of_the_release():
    assert RELEASE.place.weights.depth == RELEASE.place.weights.free_space == 80
    assert (RELEASE.place.span, RELEASE.place.chair_span) == (0.8, 0.6)
    assert (RELEASE.layout.method.steps, RELEASE.place.method.steps) == (1000, 2500)
    assert RELEASE.layout.first.steps == 200
