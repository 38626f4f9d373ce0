"""Objects that stand in each other go apart; those that do not stay where they are."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import FACES, SIZES, box_verts, make_inputs

from mover.core.observe import Energy
from mover.core.types import Layout, Mesh
from mover.energy.prior_terms import (
    CELL,
    FAR,
    OVERLAP,
    UPRIGHT,
    WIDE,
    Sections,
    outline,
    sections_of,
)
from mover.geometry.mesh import sample_surface
from mover.geometry.rotations import rot_y
from mover.stages.objects.separate_objects import separate_objects, sharing

WEIGHT = 0.3


def start():
    inputs = make_inputs()
    boxes = (Mesh(verts, FACES) for verts in inputs.objects.verts)
    samples = torch.stack([sample_surface(box, 300)[0] for box in boxes])
    return replace(inputs.objects, samples=samples), inputs.starts[0]


def overlap(objects, at):
    return sharing(objects, at)(at)


def indifferent(layout):
    """No term depends on where an object is."""
    return Energy({"none": 0.0 * layout.t_world_object.square().sum(-1)})


def stiff(home, weight=1e4):
    """Each object wants to stay; the first far more than the others."""

    def energy(layout):
        off = (layout.t_world_object - home.t_world_object).square().sum(-1)
        strength = torch.tensor([weight, 1e-3, 1e-3])
        return Energy({"home": strength * off})

    return energy


def meeting(at):
    """The second stands half in the first."""
    t = at.t_world_object.clone()
    t[1] = t[0] + torch.tensor([0.3, 0.0, 0.0])
    return replace(at, t_world_object=t)


def test_objects_apart_stay_bit_for_bit():
    objects, at = start()
    assert float(overlap(objects, at).sum()) == 0
    assert separate_objects(indifferent, objects, at, WEIGHT) is at


def test_no_weight_changes_nothing():
    objects, at = start()
    both = meeting(at)
    assert separate_objects(indifferent, objects, both, 0.0) is both


def test_who_has_no_part_in_it_stays_bit_for_bit():
    """Even where another descent would still take it elsewhere."""
    objects, at = start()
    both = meeting(at)
    elsewhere = replace(both, t_world_object=both.t_world_object + torch.tensor([0.0, 0.0, -0.5]))
    found = separate_objects(stiff(elsewhere, 1.0), objects, both, WEIGHT)
    for name in ("t_world_object", "yaw", "log_scale"):
        assert torch.equal(getattr(found, name)[2], getattr(both, name)[2])
    assert float((found.t_world_object - both.t_world_object)[:2].norm(dim=-1).min()) > 0.01


def test_who_carries_is_not_left():
    objects, at = start()
    carried = replace(objects, supports=torch.tensor([-1, 0, -1]))
    assert float(overlap(carried, meeting(at)).sum()) == 0


TOP = 0.72  # [m], underside of a table top 3 cm thick
TABLE = (
    ((1.2, 0.03, 0.8), (0.0, TOP, 0.0)),
    *(((0.05, TOP, 0.05), (x, 0.0, z)) for x in (-0.55, 0.55) for z in (-0.35, 0.35)),
)


def mesh_of(parts):
    verts = [box_verts(size) + torch.tensor(at).double() for size, at in parts]
    faces = torch.cat([FACES + 8 * k for k in range(len(parts))])
    return Mesh(torch.cat(verts).float(), faces)


def chair(seat):
    """The seat and what is below it, and a back 2 cm thick at its rear edge."""
    return (((0.44, seat, 0.42), (0.0, 0.0, 0.0)), ((0.44, 0.5, 0.02), (0.0, 0.45, -0.2)))


def table_and_chair(away, seat=0.45):
    """A table, a chair before it whose back is `away` from its edge, and a cabinet elsewhere."""
    objects, at = start()
    meshes = [mesh_of(TABLE), mesh_of(chair(seat)), mesh_of((((0.4, 1.8, 0.9), (0.0, 0.0, 0.0)),))]
    count, many = max(len(m.verts) for m in meshes), max(len(m.faces) for m in meshes)
    pad = torch.nn.functional.pad
    packed = replace(
        objects, faces=torch.stack([pad(m.faces, (0, 0, 0, many - len(m.faces))) for m in meshes]),
        verts=torch.stack([m.verts[torch.arange(count) % len(m.verts)] for m in meshes]),
        real_verts=torch.stack([torch.arange(count) < len(m.verts) for m in meshes]),
        samples=torch.stack([sample_surface(m, 400)[0] for m in meshes]),
        size=torch.stack([m.verts.amax(0) - m.verts.amin(0) for m in meshes]),
    )  # fmt: skip
    t = torch.tensor([[0.0, -1.4, -3.0], [0.1, -1.4, -3.0], [1.7, -1.4, -4.6]])
    t[1, 2] = -3.0 + 0.4 + away + 0.21  # the chair's front looks away from the table
    return packed, Layout(t, torch.zeros(3), at.log_scale)


@pytest.mark.parametrize("deep", [0.08, 0.2])
def test_a_back_through_a_thin_top_goes_out_to_the_front_and_the_table_stays(deep):
    objects, at = table_and_chair(-deep)
    found = separate_objects(stiff(at), objects, at, WEIGHT)
    moved = found.t_world_object - at.t_world_object
    back = float(at.t_world_object[1, 2] + moved[1, 2]) - 0.21 - (-3.0 + 0.4)
    assert -0.02 < back < 0.05
    assert float(moved[1, :2].abs().max()) < 0.05
    assert float(moved[0].norm()) < 0.005
    assert torch.equal(found.log_scale, at.log_scale)
    assert torch.equal(found.yaw, at.yaw)
    assert float(overlap(objects, found).sum()) < 0.01 * float(overlap(objects, at).sum())
    assert torch.equal(found.t_world_object[2], at.t_world_object[2])


@pytest.mark.parametrize(
    ("seat", "least", "most"), [(0.45, 0, 0), (TOP + 0.006, 0, 1e-3), (TOP + 0.06, 0.1, math.inf)]
)
def test_a_seat_under_the_top_costs_nothing_and_may_graze_it_from_below(seat, least, most):
    """Its upper side is 20 cm deep by the horizontal way out, but 6 mm in height."""
    objects, at = table_and_chair(-0.2, seat)
    turned = replace(at, yaw=torch.tensor([0.0, math.pi, 0.0]))  # its seat reaches under
    assert least <= float(overlap(objects, turned).sum()) <= most
    if most == 0:
        assert separate_objects(indifferent, objects, turned, WEIGHT) is turned


# The horizontal way out of a solid, however thin it is in height, and its cost.


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
    whole = mesh_of((((1.2, 0.03, 0.8), (0.0, 0.71, 0.0)), *legs))
    sections = sections_of(whole.verts.double(), whole.faces)
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


def test_the_cost_is_that_of_a_naive_loop_over_points_and_boxes():
    objects, at = start()
    t = at.t_world_object.clone()
    t[1] = t[0] + torch.tensor([0.3, 0.0, 0.1])
    scale = torch.tensor([0.1, 0.0, 0.1])
    at = replace(at, t_world_object=t, log_scale=at.log_scale + scale)
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
