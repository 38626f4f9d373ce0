"""`paper` and `release` as a run prices them: their formulas' numbers, the same bits twice."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import make_inputs, moved
from reference import use_engine

from mover.core.records import map_tensors
from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig, SceneWeights, only
from mover.energy.fused.energy import energy_function
from mover.energy.objective import HumanCues, scene_energy
from mover.energy.terms.contact import contact_term, shares_of
from mover.energy.terms.silhouette import edge_term, outline_root
from mover.geometry.placement import place
from mover.geometry.warp_start import use_threads
from mover.stages.config import ImageConfig, PlaceConfig
from mover.stages.objects.find_image_cues import ImageInputs, find_image_cues
from mover.stages.objects.place_objects import place_objects, with_trees

pytest.importorskip("warp")

RELEASE = SceneWeights(
    1000.0, 0.3, 1000.0, 80.0, 1000.0, 1e5, edge=0.03, offscreen=1.0, free_space=80.0
)
WEIGHTS = {"paper": SceneWeights(), "release": RELEASE}


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
    free = torch.where(chance(mask, 0.7), 3 + torch.rand(mask.shape, generator=g), -torch.inf)
    depth = replace(depth, near=depth.near.roll(4, -2) + 0.3, far=far - 0.4, free=free)
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


@pytest.mark.parametrize("form", ["paper", "release"])
@pytest.mark.parametrize("seed", [0, 1])
def test_kernels_give_every_term_and_its_gradient(form, seed):
    inputs = disturbed(seed)
    layout, config = many(inputs), SceneConfig(WEIGHTS[form], form)
    rest = (inputs.objects, inputs.camera, inputs.image)
    fast = energy_function(*rest, with_trees(inputs, form).humans, config)(layout)
    with use_engine("torch"):
        slow = scene_energy(layout, *rest, inputs.humans, config)
    assert list(fast.parts) == list(slow.parts)
    for name, values in slow.parts.items():
        assert values.abs().max() > 0 or name in ("offscreen", "collision")
        scale = float(values.detach().abs().max())
        torch.testing.assert_close(fast.parts[name], values, rtol=2e-5, atol=1e-5 * scale)
        found, wanted = slopes(fast.parts[name], layout), slopes(values, layout)
        for a, b in zip(found, wanted, strict=True):
            torch.testing.assert_close(a, b, rtol=2e-3, atol=1e-4 * float(b.abs().max()))


@pytest.mark.parametrize("name", ["silhouette", "edge", "depth", "free_space"])
def test_one_term_alone_is_what_it_is_among_all(name):
    inputs = disturbed()
    layout = many(inputs, 1)
    alone = SceneWeights(**{k: float(k == name) * v for k, v in vars(RELEASE).items()})
    found = []
    for weights in (RELEASE, alone):
        config = SceneConfig(weights, "release")
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
    config = SceneConfig(replace(RELEASE, contact=0.0), "release")
    rest = (inputs.camera, inputs.image, HumanCues(inputs.humans.depth))
    parts = energy_function(inputs.objects, *rest, config)(layout).parts
    image = inputs.image
    wanted = 0.3 * image.trust * (image.masks * image.keep).square().sum((-2, -1))
    torch.testing.assert_close(parts["silhouette"][0], wanted)
    for name in ("edge", "depth", "free_space"):
        assert not parts[name].any()
        assert not any(g.any() for g in slopes(parts[name], layout))


def present_edge(drawn, mask, keep):
    """The formula by one square window and distances that are measured anew."""
    from scipy.ndimage import distance_transform_edt

    def ring(image):
        flat = image.reshape(-1, 1, *image.shape[-2:])
        grown = torch.nn.functional.max_pool2d(flat, 7, stride=1, padding=3)
        return grown.reshape(image.shape) - image

    edges = ring((mask > 0.5).to(drawn))
    maps = torch.stack(
        [torch.from_numpy(distance_transform_edt(np.asarray(e == 0))) for e in edges]
    )
    return 0.5 * (ring(drawn * keep) * maps.to(drawn).sqrt()).sum((-2, -1))


@pytest.mark.parametrize("levels", [0, 4])
def test_the_edge_term_is_that_of_square_windows_with_its_gradient(levels):
    g = torch.Generator().manual_seed(levels)
    drawn = torch.rand(2, 3, 21, 30, generator=g, dtype=torch.float64)
    if levels:  # many pixels that are equally high
        drawn = (drawn * levels).round() / levels
    mask = torch.rand(3, 21, 30, generator=g, dtype=torch.float64)
    keep = torch.rand(3, 21, 30, generator=g) < 0.8
    drawn.requires_grad_()
    wanted = present_edge(drawn, mask, keep)
    for outline in (None, outline_root(mask)):
        found = edge_term(drawn, mask, keep, outline)
        torch.testing.assert_close(found, wanted)
        a, b = (torch.autograd.grad(x.sum(), drawn, retain_graph=True)[0] for x in (found, wanted))
        torch.testing.assert_close(a, b)


def test_only_the_release_keeps_the_distance_to_outlines():
    inputs, n = make_inputs(size=16), 3
    masks = torch.zeros(n, 360, 640, dtype=torch.bool)
    masks[:, 100:200, 200:400] = True
    seen = ImageInputs(
        inputs.camera, inputs.image.boxes, torch.ones(n, dtype=torch.bool), masks,
        torch.zeros(360, 640, dtype=torch.bool), torch.zeros(n, n, dtype=torch.bool),
    )  # fmt: skip
    for form in ("paper", "robust"):
        assert find_image_cues(seen, ImageConfig(32, form)).outline is None
    cues = find_image_cues(seen, ImageConfig(32, "release"))
    torch.testing.assert_close(cues.outline, outline_root(cues.masks))


def naive_contact(inputs, layout, form):
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
                    if form == "paper":
                        weight = touches.weight[k, part, known].double()
                        price = (gap.amin(1) * weight).sum() / skin[part % 2]
                    else:
                        price = gap.amin(0).mean()
                    total = total.index_put((torch.tensor([s]), torch.tensor([i])), price, True)
    return total


@pytest.mark.parametrize("form", ["paper", "release"])
def test_contact_by_trees_is_that_of_all_pairs(form):
    inputs = disturbed(3)
    g = torch.Generator().manual_seed(5)
    back = 0.4 * torch.rand(inputs.objects.back.shape, generator=g)
    inputs = replace(inputs, objects=replace(inputs.objects, back=back))
    layout = many(inputs)
    given = with_trees(inputs, form)
    config = SceneConfig(only(contact=1.0), form)
    rest = given.objects, given.camera, given.image, given.humans, config
    found = energy_function(*rest)(layout).parts["contact"]
    wanted = naive_contact(inputs, layout, form)
    torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5)
    for a, b in zip(slopes(found, layout), slopes(wanted, layout), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
    regions = (place(inputs.objects.top, layout), place(back, layout))
    present = contact_term(regions, inputs.humans.touches, form)
    torch.testing.assert_close(found, present, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("form", ["paper", "release"])
def test_two_descents_give_the_same_bits_whatever_the_threads(form):
    inputs = disturbed(2, size=48)
    config = PlaceConfig(WEIGHTS[form], form, Adam(25))
    found = []
    for threads in (1, 3, 1):
        with use_threads(threads):
            found.append(place_objects(inputs, config))
    for other in found[1:]:
        assert torch.equal(found[0].trace, other.trace)
        assert torch.equal(found[0].energy, other.energy)
        for k in vars(found[0].layout):
            assert torch.equal(getattr(found[0].layout, k), getattr(other.layout, k))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "release"])
def test_a_preset_gives_the_same_room_twice(name, small_room, tmp_path):
    from test_pipeline import light

    from mover.core.run import Run
    from mover.pipeline.reconstruct import reconstruct
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise

    capture = add_noise(small_room, NoiseConfig(), 1)
    rooms = [reconstruct(capture, light(name), Run(tmp_path / str(k))) for k in range(2)]
    for one, two in zip(rooms[0].scene.objects, rooms[1].scene.objects, strict=True):
        assert torch.equal(one.t_world_object, two.t_world_object)
        assert torch.equal(one.yaw, two.yaw)
        assert torch.equal(one.scale, two.scale)
    for trace in rooms[0].traces:
        assert torch.equal(rooms[0].traces[trace], rooms[1].traces[trace])
    assert torch.equal(rooms[0].scene.camera.R_cam_world, rooms[1].scene.camera.R_cam_world)
