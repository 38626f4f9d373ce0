"""The horizontal way out of a solid, however thin it is in height, and its cost."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import FACES, SIZES, box_verts, make_inputs

from mover.core.types import Layout, Mesh
from mover.energy.prior_terms import FAR, OVERLAP, UPRIGHT
from mover.geometry.mesh import sample_surface
from mover.geometry.rotations import rot_y
from mover.geometry.sections import CELL, WIDE, Sections, outline, sections_of
from mover.stages.objects.separate_objects import sharing


def union(*boxes):
    """Boxes (size, middle of the bottom) that overlap as one mesh."""
    verts = [box_verts(size) + torch.tensor(at, dtype=torch.float64) for size, at in boxes]
    faces = [FACES + 8 * k for k in range(len(boxes))]
    return torch.cat(verts), torch.cat(faces)


def grid_of(low, high, n=25):
    axes = (torch.linspace(a, b, n, dtype=torch.float64) for a, b in zip(low, high, strict=True))
    return torch.cartesian_prod(*axes)


def way_out(x, z, width, length):
    """Analytic depth in a rectangle round the origin [m], positive inside."""
    return torch.minimum(width / 2 - x.abs(), length / 2 - z.abs())


def uncertain(sections: Sections):
    return 0.71 * sections.outline.cell  # half the diagonal of a cell


@pytest.mark.parametrize("size", [(1.2, 0.03, 0.8), (0.5, 0.45, 0.5), (2.1, 0.5, 1.6)])
def test_the_way_out_of_a_slab_is_that_to_its_nearest_side(size):
    sections = sections_of(box_verts(size), FACES)
    reach = 0.003  # a section has the height of its cell
    points = grid_of(
        (-size[0] / 2, reach, -size[2] / 2), (size[0] / 2, size[1] - reach, size[2] / 2)
    )
    expected = way_out(points[:, 0], points[:, 2], size[0], size[2])
    off = -outline(sections, points) - expected
    assert float(off.abs().max()) <= uncertain(sections)
    assert sections.outline.cell <= max(CELL, max(size) / WIDE)


def test_above_and_below_a_thin_plate_is_free():
    sections = sections_of(box_verts((1.2, 0.03, 0.8)), FACES)
    for height in (-0.02, -0.003, 0.033, 0.05, 3.0):
        points = grid_of((-0.5, height, -0.3), (0.5, height, 0.3))
        assert float(outline(sections, points).min()) > -OVERLAP


def test_it_is_measured_along_the_sides_of_a_turned_box():
    """Turned as a mesh, 30 degrees to the cells; the depth is that in the box's own frame."""
    turn = rot_y(torch.tensor(math.radians(30.0), dtype=torch.float64))
    size = (1.0, 0.6, 0.4)
    sections = sections_of(box_verts(size) @ turn.mT, FACES)
    points = grid_of((-0.49, 0.05, -0.19), (0.49, 0.55, 0.19))
    expected = way_out(points[:, 0], points[:, 2], 1.0, 0.4)
    off = -outline(sections, points @ turn.mT) - expected
    assert float(off.abs().max()) <= 1.5 * uncertain(sections)  # its border is stairs


def test_under_a_table_it_is_free_between_the_legs():
    legs = [((0.05, 0.72, 0.05), (x, 0.0, z)) for x in (-0.5, 0.5) for z in (-0.3, 0.3)]
    sections = sections_of(*union(((1.2, 0.03, 0.8), (0.0, 0.71, 0.0)), *legs))
    inner = grid_of((-0.4, 0.01, -0.2), (0.4, 0.69, 0.2))
    assert float(outline(sections, inner).min()) > 0
    top = grid_of((-0.6, 0.725, -0.4), (0.6, 0.725, 0.4))
    expected = way_out(top[:, 0], top[:, 2], 1.2, 0.8)
    assert float((-outline(sections, top) - expected).abs().max()) <= uncertain(sections)
    leg = torch.tensor([[0.5, 0.3, 0.3]], dtype=torch.float64)
    assert float(-outline(sections, leg)) == pytest.approx(0.025, abs=uncertain(sections))


def test_the_gradient_leads_the_short_way_out_and_not_up():
    sections = sections_of(box_verts((1.2, 0.03, 0.8)), FACES)
    points = torch.tensor([[0.1, 0.012, 0.25], [-0.45, 0.02, 0.1]], dtype=torch.float64)
    points.requires_grad_()
    outline(sections, points).sum().backward()
    expected = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(points.grad, expected, rtol=0, atol=1e-3)

    def across(flat):
        return outline(sections, torch.stack([flat[:, 0], points.detach()[:, 1], flat[:, 1]], -1))

    flat = points.detach()[:, [0, 2]].clone().requires_grad_()
    assert torch.autograd.gradcheck(across, (flat,))


def test_the_price_is_that_of_a_naive_loop_over_points_and_boxes():
    inputs = make_inputs()
    at = Layout(*(x[0] for x in vars(inputs.starts).values()))
    t = at.t_world_object.clone()
    t[1] = t[0] + torch.tensor([0.3, 0.0, 0.1])
    scale = torch.tensor([0.1, 0.0, 0.1])
    at = replace(at, t_world_object=t, log_scale=at.log_scale + scale)
    boxes = [sample_surface(Mesh(v, FACES), 300)[0] for v in inputs.objects.verts]
    objects = replace(inputs.objects, samples=torch.stack(boxes))
    found = sharing(objects, at)(at)
    expected = torch.tensor([naive(objects, at, i, 1 - i) for i in range(2)] + [0.0])
    assert float(expected.max()) > 1
    torch.testing.assert_close(found, expected, rtol=0.06, atol=1e-3)


def naive(objects, at, one, other):
    total, size, grown = 0.0, SIZES[other], math.exp(0.1)
    for sample in objects.samples[one]:
        world = rot_y(at.yaw[one]) @ (sample * at.log_scale[one].exp()) + at.t_world_object[one]
        x, y, z = (rot_y(at.yaw[other]).mT @ (world - at.t_world_object[other])).tolist()
        deep = min(size[0] * grown / 2 - abs(x), size[2] * grown / 2 - abs(z)) - OVERLAP
        upright = UPRIGHT < sample[1] < SIZES[one][1] - UPRIGHT
        if 0 < y < size[1] and deep > 0 and upright:
            total += deep**2 if deep < FAR else 2 * FAR * deep - FAR**2
    return 1000 * total / len(objects.samples[one])
