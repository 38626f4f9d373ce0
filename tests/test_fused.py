"""Eq. 1 by one kernel (`robust`) and by engines (`paper`) against the terms one by one."""

import functools
from dataclasses import replace

import pytest
import torch
from analytic import humans_at, image_at, make_inputs, moved, several, walls_at
from reference import use_engine, use_threads
from test_raster import packed

from mover.core.observe import Energy
from mover.core.records import map_tensors, record
from mover.energy.config import Adam, SceneConfig, SceneWeights, only
from mover.energy.fused.energy import energy_function, energy_of_rows
from mover.energy.human_terms import DepthRange, contact_distance, contact_term, shares_of
from mover.energy.image_terms import LEAST, LIKELY, UNKNOWN
from mover.energy.minimize import minimize
from mover.energy.objective import HumanCues, scene_energy
from mover.geometry.placement import place
from mover.geometry.rotations import axis_angle
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_objects import place_objects

pytest.importorskip("warp")
WEIGHTS = SceneWeights(1.0, 1.0, 0.3, 0.2, 0.1, 0.2, distance=0.02, heading=0.1, wall=0.05)
PAPER = SceneWeights()
GROWTH = 2.5  # not the usual one
TERMS = (
    "bbox", "silhouette", "scale", "depth", "collision", "contact", "distance", "heading", "wall"
)  # fmt: skip


@functools.cache
def room(size=64):
    """The analytic room with curved and padded shapes in the place of its boxes."""
    inputs = make_inputs(size=size)
    verts, shape = packed(["chair", "torus", "sofa"], extra=5)
    verts = verts - verts.amin(1, keepdim=True) * torch.tensor([0.0, 1.0, 0.0])
    number = torch.arange(verts.shape[1])
    objects = replace(
        inputs.objects, verts=verts, faces=shape.faces, edges=shape.edges,
        real_verts=number <= shape.faces.flatten(1).amax(1)[:, None],
    )  # fmt: skip
    at = inputs.starts[0]
    image = replace(
        image_at(objects, at, inputs.camera, size), distance=at.t_world_object.norm(dim=-1),
        walls=walls_at(objects, at),
    )  # fmt: skip
    humans = humans_at(objects, at, inputs.camera, image)
    return replace(inputs, objects=objects, image=image, humans=humans)


def rest_of(inputs):
    return inputs.objects, inputs.camera, inputs.image, inputs.humans


def both(inputs, weights=WEIGHTS):
    """The energy by one kernel, and term by term."""
    rest = *rest_of(inputs), SceneConfig(weights, "robust", GROWTH)
    fast = energy_function(*rest)
    assert fast(inputs.starts).whole is not None
    return fast, lambda layout: scene_energy(layout, *rest)


def free(layout):
    return map_tensors(lambda x: x.detach().clone().requires_grad_(), layout)


def slopes(values, layout):
    leaves = [layout.t_world_object, layout.yaw, layout.log_scale]
    return torch.autograd.grad(
        values.sum(), leaves, retain_graph=True, allow_unused=True, materialize_grads=True
    )


def rows_of(parts):
    """One row for each item, of what belongs to place, yaw and size."""
    return torch.cat([parts[0], parts[1].unsqueeze(-1), parts[2]], -1)


def with_slopes(energy, layout):
    """Energy of each item, and its gradient in one row for each item."""
    at = free(layout)
    value = energy(at).per_item
    return value.detach(), rows_of(slopes(value, at))


def agree(fast, slow, layout, *terms):
    """Values to 1e-5, gradients of all items together to 1e-3; of the whole, or of some terms."""
    at = free(layout)
    found, wanted = fast(at), slow(at)
    for term in terms or (None,):
        value, truth = (e.per_item if term is None else e.parts[term] for e in (found, wanted))
        torch.testing.assert_close(value, truth, rtol=1e-5, atol=1e-5)
        slope, exact = (rows_of(slopes(v, at)) for v in (value, truth))
        assert (slope - exact).norm() <= 1e-3 * exact.norm() + 1e-6
    return value.detach()


class TestAgreement:
    @pytest.mark.parametrize("size", [33, 64, 130])
    def test_each_term_and_its_gradient_are_those_of_the_term_itself(self, size):
        inputs = room(size)
        energies, layout = both(inputs), several(inputs.starts)
        agree(*energies, layout, *TERMS)
        parts = energies[0](layout).parts
        assert all(term == "collision" or float(parts[term].sum()) > 0 for term in TERMS)

    @pytest.mark.parametrize("missing", ["weights", "walls"])
    def test_their_sum_is_the_energy_and_what_is_missing_leaves_no_term(self, missing):
        inputs, weights, less = room(), WEIGHTS, {"wall"}
        if missing == "weights":
            weights, less = replace(WEIGHTS, depth=0.0, contact=0.0), {"depth", "contact"}
        else:
            inputs = replace(inputs, image=replace(inputs.image, walls=None))
        fast, slow = both(inputs, weights)
        layout = several(inputs.starts)
        assert set(fast(layout).parts) == set(slow(layout).parts) == set(TERMS) - less
        agree(fast, slow, layout)

    @pytest.mark.parametrize("parts", [False, True])
    def test_so_is_what_another_rotation_of_the_camera_costs_and_its_gradient(self, parts):
        inputs = room(130)
        weights = replace(WEIGHTS, collision=0.0, contact=0.0, wall=0.0, heading=0.0)
        fast, _ = both(inputs, weights)
        rest, layout = (inputs.image, inputs.humans), several(inputs.starts)
        before, found = fast(layout).per_item, []
        for way in (
            fast,
            lambda layout, turn: scene_energy(
                layout, inputs.objects, replace(inputs.camera, R_cam_world=turn), *rest,
                SceneConfig(weights, "robust", GROWTH),
            ),
        ):  # fmt: skip
            free = torch.tensor([0.02, -0.03, 0.01], requires_grad=True)
            energy = way(layout, axis_angle(free) @ inputs.camera.R_cam_world)
            each = energy.per_item
            summed = torch.stack(list(energy.parts.values())).sum(0) if parts else each
            (slope,) = torch.autograd.grad(summed.sum(), free)
            found.append((each.detach(), slope))
        torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-5, atol=1e-5)
        assert (found[0][1] - found[1][1]).norm() <= 1e-3 * found[1][1].norm()
        assert not torch.allclose(found[0][0], before)
        assert torch.equal(fast(layout).per_item, before)

    def test_some_rows_of_the_starts_cost_what_they_cost_among_all(self):
        inputs = room()
        fast, layout = both(inputs)[0], several(inputs.starts)
        value, slope = (x.flatten(0, 1) for x in with_slopes(fast, layout))
        some = energy_of_rows(*rest_of(inputs), SceneConfig(WEIGHTS, "robust", GROWTH))
        for numbers in ([4], [8, 0, 5], [5, 0], list(range(9)), [7, 1, 2, 3]):
            rows = torch.tensor(numbers)
            few = map_tensors(lambda x, rows=rows: x.flatten(0, 1)[rows], layout)
            found = with_slopes(some(rows), few)
            assert torch.equal(found[0], value[rows])
            assert torch.equal(found[1], slope[rows])

    @pytest.mark.parametrize("shift", [(0.0, 0.0, 2.5), (0.0, 0.0, 9.0), (40.0, 0.0, 0.0)])
    def test_so_are_those_of_objects_before_behind_and_beside_the_camera(self, shift):
        inputs = room()
        layout = several(inputs.starts)
        away = replace(layout, t_world_object=layout.t_world_object + torch.tensor(shift))
        assert agree(*both(inputs), away).isfinite().all()

    def test_bounds_on_few_pixels_count_there_only(self):
        inputs = room()
        depth = inputs.humans.depth
        few = torch.zeros_like(depth.near, dtype=torch.bool)
        few[0, 20:40, 30:50] = few[2, 31, 32] = True
        near = torch.where(few, 4.0, -torch.inf)
        bounds = DepthRange(near, torch.full_like(near, torch.inf), depth.area)
        inputs = replace(inputs, humans=replace(inputs.humans, depth=bounds))
        value = agree(*both(inputs), several(inputs.starts), "depth")
        assert (value[:, 1] == 0).all()
        assert (value[:, 0] > 0).all()

    def test_unknown_pixels_weak_trust_and_fractional_masks_are_used(self):
        inputs = room()
        image = inputs.image
        keep, sides = image.keep.clone(), image.sides.clone()
        keep[:, :, 20:40] = False
        masks = torch.nn.functional.avg_pool2d(image.masks, 5, 1, 2)
        sides[0, 1] = sides[1] = UNKNOWN
        sides[2, ::2] = sides[0, 2] = LEAST
        sides[2, 1] = sides[0, 3] = LIKELY
        trust = torch.tensor([0.2, 1.0, 0.7])
        image = replace(image, keep=keep, masks=masks, sides=sides, trust=trust)
        agree(*both(replace(inputs, image=image)), several(inputs.starts), "silhouette", "bbox")

    def test_sizes_far_from_the_usual_cost_what_they_should(self):
        inputs = room()
        layout = several(inputs.starts)
        sizes = torch.linspace(-0.8, 0.8, layout.log_scale.numel()).view_as(layout.log_scale)
        agree(*both(inputs), replace(layout, log_scale=sizes), "scale")

    def test_any_number_of_threads_and_any_history_give_the_same_bits(self):
        inputs = room()
        layout, other, runs = several(inputs.starts), several(inputs.starts, 5, 0.3), []
        for threads in (1, 2, 3):
            fast, _ = both(inputs)
            with use_threads(threads):
                for _ in range(2):
                    runs.append(with_slopes(fast, layout))
                    with_slopes(fast, other)
        for run in runs[1:]:
            assert all(map(torch.equal, run, runs[0]))
        assert torch.equal(fast(other).per_item[2], fast(other[2]).per_item)

    def test_other_forms_precisions_engines_and_open_meshes_are_summed_term_by_term(self):
        inputs, robust = room(), SceneConfig(WEIGHTS, "robust")
        double = make_inputs(torch.float64, size=16)
        faces = inputs.objects.faces.clone()
        faces[0, 3] = 0
        opened = replace(inputs, objects=replace(inputs.objects, faces=faces))
        for some, config, engine, fused in (
            (inputs, robust, "warp", True),
            (inputs, robust, "torch", False),
            (inputs, SceneConfig(WEIGHTS, "paper"), "warp", False),
            (double, robust, "warp", False),
            (opened, robust, "warp", False),
        ):
            with use_engine(engine):
                found = energy_function(*rest_of(some), config)(some.starts)
            assert (found.whole is not None) == fused


@record
class Point:
    """Unknowns in two fields."""

    x: torch.Tensor
    y: torch.Tensor


@pytest.mark.parametrize("keep_best", [False, True])
def test_the_descent_has_the_bits_of_torchs_adam(keep_best):
    r = torch.Generator().manual_seed(0)
    start = Point(torch.randn(3, 4, generator=r), torch.randn(3, 4, 2, generator=r))

    def energy(p):
        return Energy({"rough": (3 * p.x).sin() + p.x.square() + (p.y - 1).square().sum(-1)})

    method = Adam(40, 0.1, 0.01, beta2=0.98, keep_best=keep_best)
    found = minimize(energy, start, method)
    x, y = (getattr(start, n).clone().requires_grad_() for n in ("x", "y"))
    adam = torch.optim.Adam([x, y], betas=(0.9, 0.98))
    seen = []
    for k in range(41):
        value = energy(Point(x, y)).per_item
        seen.append((value.detach().clone(), x.detach().clone(), y.detach().clone()))
        adam.param_groups[0]["lr"] = 0.1 * 0.1 ** (k / 39)
        adam.zero_grad()
        value.sum().backward()
        adam.step()
    values, xs, ys = (torch.stack(s) for s in zip(*seen, strict=True))
    best = values.argmin(0) if keep_best else torch.full((3, 4), 40)
    assert torch.equal(found.at.x, xs.gather(0, best[None])[0])
    assert torch.equal(found.at.y, ys.gather(0, best[None, ..., None].expand(1, 3, 4, 2))[0])
    assert torch.equal(found.value, values.gather(0, best[None])[0])
    torch.testing.assert_close(found.trace, values[:40].sum((1, 2)))


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


class TestPaper:
    """The form `paper` as a run computes it: the numbers of its formulas, the same bits twice."""

    @pytest.mark.parametrize("seed", [0, 1])
    def test_kernels_give_every_term_and_its_gradient(self, seed):
        inputs = disturbed(seed)
        layout, rest = free(several(inputs.starts, 3, 0.15)), (*rest_of(inputs), SceneConfig())
        fast = energy_function(*rest)(layout)
        with use_engine("torch"):
            slow = scene_energy(layout, *rest)
        assert list(fast.parts) == list(slow.parts)
        for name, values in slow.parts.items():
            assert values.abs().max() > 0 or name == "collision"
            scale = float(values.detach().abs().max())
            torch.testing.assert_close(fast.parts[name], values, rtol=2e-5, atol=1e-5 * scale)
            found, wanted = slopes(fast.parts[name], layout), slopes(values, layout)
            for a, b in zip(found, wanted, strict=True):
                torch.testing.assert_close(a, b, rtol=2e-3, atol=1e-4 * float(b.abs().max()))

    @pytest.mark.parametrize("name", ["silhouette", "depth"])
    def test_one_term_alone_is_what_it_is_among_all(self, name):
        inputs, found = disturbed(), []
        layout = free(moved(inputs.starts, 0, 0.15))
        humans = replace(inputs.humans, touches=None)
        for weights in (PAPER, only(**{name: getattr(PAPER, name)})):
            rest = inputs.objects, inputs.camera, inputs.image, humans, SceneConfig(weights)
            parts = energy_function(*rest)(layout).parts
            found.append([parts[name], *slopes(parts[name], layout)])
        assert set(parts) == {name}
        assert all(map(torch.equal, *found))

    def test_objects_out_of_sight_cost_their_masks_and_have_no_gradient(self):
        inputs = disturbed()
        layout = free(replace(inputs.starts, t_world_object=inputs.starts.t_world_object + 50.0))
        config, humans = SceneConfig(replace(PAPER, contact=0.0)), HumanCues(inputs.humans.depth)
        image = inputs.image
        energy = energy_function(inputs.objects, inputs.camera, image, humans, config)
        parts = energy(layout).parts
        wanted = 0.3 * image.trust * (image.masks * image.keep).square().sum((-2, -1))
        torch.testing.assert_close(parts["silhouette"][0], wanted)
        assert not parts["depth"].any()
        assert not any(g.any() for g in slopes(parts["depth"], layout))

    @pytest.mark.parametrize("engine", ["warp", "torch"])
    def test_contact_is_that_of_all_pairs(self, engine):
        inputs = disturbed(3)
        g = torch.Generator().manual_seed(5)
        back = 0.4 * torch.rand(inputs.objects.back.shape, generator=g)
        inputs = replace(inputs, objects=replace(inputs.objects, back=back))
        layout = free(several(inputs.starts, 3, 0.15))
        with use_engine(engine):
            energy = energy_function(*rest_of(inputs), SceneConfig(only(contact=1.0)))
            found = energy(layout).parts["contact"]
        wanted = naive_contact(inputs, layout)
        torch.testing.assert_close(found.double(), wanted, rtol=1e-5, atol=1e-5)
        for a, b in zip(slopes(found, layout), slopes(wanted, layout), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
        touches = inputs.humans.touches
        distance = contact_distance(layout, inputs.objects, touches)
        present = contact_term(distance, touches, len(inputs.objects.ids), "paper")
        torch.testing.assert_close(found, present, rtol=1e-4, atol=1e-4)

    def test_two_descents_give_the_same_bits_whatever_the_threads(self):
        inputs, config, found = disturbed(2, size=48), PlaceConfig(PAPER, method=Adam(25)), []
        for threads in (1, 3, 1):
            with use_threads(threads):
                placed = place_objects(inputs, config)
            found.append([placed.trace, placed.energy, *vars(placed.layout).values()])
        for other in found[1:]:
            assert all(map(torch.equal, found[0], other))


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
