"""The outlines of bodies against their masks: what is found, and what it costs."""

from dataclasses import replace

import pytest
import torch
from analytic import FACES, box_verts

from mover.core.types import Camera
from mover.energy.body_terms import OUTLINE_POINTS, Outline, outline_term
from mover.geometry.camera import project
from mover.geometry.raster import Crops, layers
from mover.stages.masks import MaskTable
from mover.stages.people.body_evidence import SeenBodies, gather_outlines
from mover_bench.rooms.render import encode

K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
CAMERA = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), 640, 480)
NOTHING = torch.full((480, 640), torch.inf)


def seen_box(x: float, front: torch.Tensor = NOTHING, deep: float = 4.0) -> SeenBodies:
    """A box as tall as a person, in camera axes."""
    verts = (box_verts((0.5, 1.6, 0.3)).float() + torch.tensor([x, -0.8, deep]))[None]
    return SeenBodies(verts, FACES, verts, CAMERA, front)


def drawn(seen: SeenBodies) -> torch.Tensor:
    return layers(seen.verts, seen.faces, Crops(K[None], 480, 640)).front[0].isfinite()


def wish(seen: SeenBodies, mask: torch.Tensor | None) -> Outline:
    masks = encode([(NOTHING < 0 if mask is None else mask).numpy()])
    table = MaskTable(masks, (None if mask is None else 0,), ((),))
    return gather_outlines(seen, table, torch.tensor([0]))


def step(outline: Outline) -> torch.Tensor:
    """The shift in the image that the outline asks for, by least squares [px], and its border."""
    ways = torch.cat([outline.normal, torch.ones_like(outline.gap)[:, None]], -1)
    return torch.linalg.lstsq(ways, -outline.gap[:, None]).solution[:, 0]


def test_a_body_beside_its_mask_is_asked_to_go_there():
    here, there = seen_box(0.0), seen_box(0.03)
    way = project(there.verts, K).mean(1) - project(here.verts, K).mean(1)
    found = step(wish(here, drawn(there)))[:2]
    torch.testing.assert_close(found, way[0], atol=0.5, rtol=0)
    assert step(wish(here, drawn(here))).abs().max() < 0.3


def test_a_mask_too_wide_all_around_says_nothing():
    own = drawn(seen_box(0.0))
    wide = torch.nn.functional.max_pool2d(own.float()[None, None], 7, 1, 3)[0, 0] > 0.5
    outline = wish(seen_box(0.0), wide)
    assert outline.gap.abs().median() < 1
    assert step(outline)[:2].abs().max() < 0.4


def test_where_furniture_may_hide_the_body_the_mask_is_not_used():
    front = NOTHING.clone()
    front[260:] = 2.0
    cut = drawn(seen_box(0.0)) & torch.arange(480)[:, None].lt(260)
    outline = wish(seen_box(0.0, front), cut)
    assert len(outline.body)
    assert outline.normal[:, 1].max() < 0.5  # nothing of its bottom, where the mask ends
    assert step(outline)[0].abs() < 0.3


def test_bodies_without_a_mask_or_without_overlap_have_no_outline():
    assert not len(wish(seen_box(0.0), None).body)
    assert not len(wish(seen_box(-1.0), drawn(seen_box(1.0))).body)


def test_the_cost_is_zero_where_outlines_meet_and_is_shared_by_the_points():
    outline = wish(seen_box(0.0), drawn(seen_box(0.04)))
    assert float(outline.weight.sum()) == pytest.approx(OUTLINE_POINTS)
    skin = seen_box(0.0).skin.double()
    at = replace(outline, gap=torch.zeros_like(outline.gap), pixel=project(skin, K.double())[0][
        outline.skin].float())  # fmt: skip
    assert float(outline_term(skin, at, K.double(), 640)) < 1e-6
    off, moved = (seen_box(x).skin.double() for x in (0.0, 0.04))
    before, after = (float(outline_term(s, outline, K.double(), 640)) for s in (off, moved))
    assert after < 0.2 * before


def test_the_gradient_of_the_cost_equals_finite_differences():
    outline = wish(seen_box(0.0), drawn(seen_box(0.02)))
    outline = replace(
        outline, pixel=outline.pixel.double(), normal=outline.normal.double(),
        gap=outline.gap.double(), weight=outline.weight.double(),
    )  # fmt: skip
    skin = seen_box(0.0).skin.double().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: outline_term(x, outline, K.double(), 640), (skin,), eps=1e-6, atol=1e-4
    )
