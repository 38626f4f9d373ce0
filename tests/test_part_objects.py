"""Objects that stand in each other go apart; those that do not stay where they are."""

import math
from dataclasses import replace

import pytest
import torch
from analytic import FACES, box_verts, make_inputs

from mover.core.observe import Energy
from mover.core.types import Layout, Mesh
from mover.geometry.mesh import sample_surface
from mover.stages.objects.separate_objects import separate_objects, sharing

WEIGHT = 0.3


def start():
    inputs = make_inputs()
    at = Layout(*(x[0] for x in vars(inputs.starts).values()))
    boxes = (Mesh(verts, FACES) for verts in inputs.objects.verts)
    samples = torch.stack([sample_surface(box, 300)[0] for box in boxes])
    return replace(inputs.objects, samples=samples), at


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


def test_one_inside_another_goes_out_and_the_sure_one_stays():
    objects, at = start()
    both = meeting(at)
    before = overlap(objects, both)
    found = separate_objects(stiff(both), objects, both, WEIGHT)
    after = overlap(objects, found)
    assert float(before.sum()) > 0.1
    assert float(after.sum()) < 0.02 * float(before.sum())
    moved = (found.t_world_object - both.t_world_object).norm(dim=-1)
    assert float(moved[0]) < 0.005
    assert float(moved[1]) > 0.05
    assert torch.equal(found.t_world_object[2], both.t_world_object[2])


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
    most_verts = max(len(m.verts) for m in meshes)
    most_faces = max(len(m.faces) for m in meshes)
    verts = [torch.cat([m.verts, m.verts[:1].expand(most_verts - len(m.verts), 3)]) for m in meshes]
    faces = [torch.cat([m.faces, m.faces.new_zeros(most_faces - len(m.faces), 3)]) for m in meshes]
    real = torch.stack([torch.arange(most_verts) < len(m.verts) for m in meshes])
    samples = torch.stack([sample_surface(m, 400)[0] for m in meshes])
    packed = replace(
        objects, verts=torch.stack(verts), faces=torch.stack(faces), real_verts=real,
        samples=samples, size=torch.stack([m.verts.amax(0) - m.verts.amin(0) for m in meshes]),
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


def test_a_seat_under_the_top_costs_nothing_where_the_back_is_outside():
    objects, at = table_and_chair(-0.2)
    turned = replace(at, yaw=torch.tensor([0.0, math.pi, 0.0]))  # its seat reaches under
    assert float(overlap(objects, at).sum()) > 0
    assert float(overlap(objects, turned).sum()) == 0
    assert separate_objects(indifferent, objects, turned, WEIGHT) is turned


def test_a_seat_that_grazes_the_top_from_below_may_stay():
    """Its upper side is 20 cm deep by the horizontal way out, but 6 mm in height."""

    def price_of(seat):
        objects, at = table_and_chair(-0.2, seat)
        return float(overlap(objects, replace(at, yaw=torch.tensor([0.0, math.pi, 0.0]))).sum())

    assert price_of(TOP + 0.006) < 1e-3
    assert price_of(TOP + 0.06) > 0.1
