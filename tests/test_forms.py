"""The form `paper` as a run computes it: the numbers of its formulas, the same bits twice.

Whole runs are compared byte for byte in `test_pipeline.py`.
"""

from dataclasses import replace

import pytest
import torch
from analytic import make_inputs, moved
from reference import use_engine

from mover.core.records import map_tensors
from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig, SceneWeights, only
from mover.energy.fused.energy import energy_function
from mover.energy.human_terms import contact_distance, contact_term, shares_of
from mover.energy.objective import HumanCues, scene_energy
from mover.geometry.placement import place
from mover.geometry.warp_start import use_threads
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_objects import place_objects, with_trees

pytest.importorskip("warp")

PAPER = SceneWeights()


def disturbed(seed=0, size=64):
    """Masks, bounds and touching points that are wrong in many ways."""
    inputs, g = make_inputs(size=size), torch.Generator().manual_seed(seed)

    def chance(like, share):
        return torch.rand(like.shape, generator=g) < share

    image, depth, touches = inputs.image, inputs.humans.depth, inputs.humans.touches
    mask = image.masks.roll((3, -4), (-2, -1))
    mask[0, 20:30, 15:40] = 0.6
    keep = ~torch.nn.functional.max_pool2d(chance(mask, 0.01).float(), 5, 1, 2).bool()
    keep[1] = False
    image = replace(image, masks=mask, keep=keep, trust=torch.tensor([1.0, 0.5, 0.2]))
    far = torch.where(chance(mask, 0.3), depth.far.roll(5, -1), torch.inf)
    depth = replace(depth, near=depth.near.roll(4, -2) + 0.3, far=far - 0.4)
    points = touches.points + 0.2 * torch.rand(touches.points.shape, generator=g)
    weight = torch.rand(touches.weight.shape, generator=g) * chance(touches.weight, 0.4)
    weight[1, 1:3] = 0.0
    touches = replace(touches, points=points, weight=weight, share=shares_of(weight))
    humans = replace(inputs.humans, depth=depth, touches=touches)
    return replace(inputs, image=image, humans=humans)


def many(inputs, seeds=3):
    layouts = [moved(inputs.starts, s, 0.15) for s in range(seeds)]
    found = map_tensors(lambda x: x, layouts[0])
    for other in layouts[1:]:
        found = Layout(*(torch.cat([getattr(found, k), getattr(other, k)]) for k in vars(found)))
    return map_tensors(lambda x: x.detach().requires_grad_(), found)


def slopes(values, layout):
    free = [layout.t_world_object, layout.yaw, layout.log_scale]
    found = torch.autograd.grad(values.sum(), free, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(x) if g is None else g for g, x in zip(found, free, strict=True)]


@pytest.mark.parametrize("seed", [0, 1])
def test_kernels_give_every_term_and_its_gradient(seed):
    inputs = disturbed(seed)
    layout, config = many(inputs), SceneConfig(PAPER, "paper")
    rest = (inputs.objects, inputs.camera, inputs.image)
    fast = energy_function(*rest, with_trees(inputs).humans, config)(layout)
    with use_engine("torch"):
        slow = scene_energy(layout, *rest, inputs.humans, config)
    assert list(fast.parts) == list(slow.parts)
    for name, values in slow.parts.items():
        assert values.abs().max() > 0 or name == "collision"
        scale = float(values.detach().abs().max())
        torch.testing.assert_close(fast.parts[name], values, rtol=2e-5, atol=1e-5 * scale)
        found, wanted = slopes(fast.parts[name], layout), slopes(values, layout)
        for a, b in zip(found, wanted, strict=True):
            torch.testing.assert_close(a, b, rtol=2e-3, atol=1e-4 * float(b.abs().max()))


@pytest.mark.parametrize("name", ["silhouette", "depth"])
def test_one_term_alone_is_what_it_is_among_all(name):
    inputs = disturbed()
    layout = many(inputs, 1)
    alone = SceneWeights(**{k: float(k == name) * v for k, v in vars(PAPER).items()})
    found = []
    for weights in (PAPER, alone):
        config = SceneConfig(weights, "paper")
        rest = (inputs.camera, inputs.image, replace(inputs.humans, touches=None))
        parts = energy_function(inputs.objects, *rest, config)(layout).parts
        found.append([parts[name], *slopes(parts[name], layout)])
    assert set(parts) == {name}
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


def test_objects_out_of_sight_cost_their_masks_and_have_no_gradient():
    inputs = disturbed()
    away = replace(inputs.starts, t_world_object=inputs.starts.t_world_object + 50.0)
    layout = map_tensors(lambda x: x.detach().requires_grad_(), away)
    config = SceneConfig(replace(PAPER, contact=0.0), "paper")
    rest = (inputs.camera, inputs.image, HumanCues(inputs.humans.depth))
    parts = energy_function(inputs.objects, *rest, config)(layout).parts
    image = inputs.image
    wanted = 0.3 * image.trust * (image.masks * image.keep).square().sum((-2, -1))
    torch.testing.assert_close(parts["silhouette"][0], wanted)
    assert not parts["depth"].any()
    assert not any(g.any() for g in slopes(parts["depth"], layout))


def naive_contact(inputs, layout):
    """Double loops over objects and parts in double precision."""
    wide = map_tensors(lambda x: x.double(), layout)
    tops, backs = (place(x.double(), wide) for x in (inputs.objects.top, inputs.objects.back))
    touches, total = inputs.humans.touches, torch.zeros(wide.yaw.shape, dtype=torch.float64)
    skin = [touches.weight[:, [k, k + 2]].double().sum() for k in (0, 1)]  # of seats, of backs
    for s in range(len(total)):
        for k, i in enumerate(touches.object_of.tolist()):
            for part, region in enumerate((tops, backs, tops, backs)):
                known = touches.weight[k, part] > 0
                if known.any():
                    points = touches.points[k, part, known].double()
                    gap = (points[:, None] - region[s, i][None]).norm(dim=-1)
                    weight = touches.weight[k, part, known].double()
                    cost = (gap.amin(1) * weight).sum() / skin[part % 2]
                    total = total.index_put((torch.tensor([s]), torch.tensor([i])), cost, True)
    return total


def test_contact_by_trees_is_that_of_all_pairs():
    inputs = disturbed(3)
    g = torch.Generator().manual_seed(5)
    back = 0.4 * torch.rand(inputs.objects.back.shape, generator=g)
    inputs = replace(inputs, objects=replace(inputs.objects, back=back))
    layout = many(inputs)
    given = with_trees(inputs)
    config = SceneConfig(only(contact=1.0), "paper")
    rest = given.objects, given.camera, given.image, given.humans, config
    found = energy_function(*rest)(layout).parts["contact"]
    wanted = naive_contact(inputs, layout)
    torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5)
    for a, b in zip(slopes(found, layout), slopes(wanted, layout), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
    touches = inputs.humans.touches
    distance = contact_distance(layout, inputs.objects, touches)
    present = contact_term(distance, touches, len(inputs.objects.ids), "paper")
    torch.testing.assert_close(found, present, rtol=1e-4, atol=1e-4)


def test_two_descents_give_the_same_bits_whatever_the_threads():
    inputs = disturbed(2, size=48)
    config = PlaceConfig(PAPER, "paper", Adam(25))
    found = []
    for threads in (1, 3, 1):
        with use_threads(threads):
            found.append(place_objects(inputs, config))
    for other in found[1:]:
        assert torch.equal(found[0].trace, other.trace)
        assert torch.equal(found[0].energy, other.energy)
        for k in vars(found[0].layout):
            assert torch.equal(getattr(found[0].layout, k), getattr(other.layout, k))
