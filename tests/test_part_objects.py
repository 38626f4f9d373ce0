"""Objects that stand in each other go apart; those that do not stay where they are."""

from dataclasses import replace

import torch
from analytic import make_inputs

from mover.minimize import Energy
from mover.stages.part_objects import part_objects, sharing
from mover.types import Layout

WEIGHT = 0.3


def start():
    inputs = make_inputs()
    at = Layout(*(x[0] for x in vars(inputs.starts).values()))
    return inputs.objects, at


def overlap(objects, at):
    return sharing(objects, at)(at)


def indifferent(layout):
    """Nobody minds where an object is."""
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
    assert part_objects(indifferent, objects, at, WEIGHT) is at


def test_no_weight_changes_nothing():
    objects, at = start()
    both = meeting(at)
    assert part_objects(indifferent, objects, both, 0.0) is both


def test_one_inside_another_goes_out_and_the_sure_one_stays():
    objects, at = start()
    both = meeting(at)
    before = overlap(objects, both)
    found = part_objects(stiff(both), objects, both, WEIGHT)
    after = overlap(objects, found)
    assert float(before.sum()) > 0.1
    assert float(after.sum()) < 0.02 * float(before.sum())
    moved = (found.t_world_object - both.t_world_object).norm(dim=-1)
    assert float(moved[0]) < 0.005
    assert float(moved[1]) > 0.05
    assert torch.equal(found.t_world_object[2], both.t_world_object[2])


def test_who_carries_is_not_left():
    objects, at = start()
    carried = replace(objects, supports=torch.tensor([-1, 0, -1]))
    assert float(overlap(carried, meeting(at)).sum()) == 0
