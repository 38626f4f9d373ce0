"""Eq. 1 by one kernel against the terms one by one, and against itself."""

from dataclasses import fields, replace

import pytest
import torch
from analytic import humans_at, image_at, make_inputs, moved, walls_at
from reference import use_engine
from test_raster import packed

from mover.core.observe import Energy
from mover.core.records import record
from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig, SceneWeights
from mover.energy.fused.energy import energy_function, energy_of_rows
from mover.energy.human_terms import DepthRange
from mover.energy.image_terms import LEAST, LIKELY, UNKNOWN
from mover.energy.minimize import minimize
from mover.energy.objective import scene_energy
from mover.geometry.rotations import axis_angle
from mover.geometry.topology import edges_of
from mover.geometry.warp_start import use_threads
from mover.stages.objects.place_objects import with_trees

pytest.importorskip("warp")
WEIGHTS = SceneWeights(1.0, 1.0, 0.3, 0.2, 0.1, 0.2, distance=0.02, heading=0.1, wall=0.05)
GROWTH = 2.5  # not the usual one
TERMS = (
    "bbox", "silhouette", "scale", "depth", "collision", "contact", "distance", "heading", "wall"
)  # fmt: skip


def room(size=64, names=("chair", "torus", "sofa"), **changes):
    """The analytic room with curved and padded shapes in the place of its boxes."""
    inputs = make_inputs(size=size)
    verts, shape = packed(list(names), extra=5)
    verts = verts - verts.amin(1, keepdim=True) * torch.tensor([0.0, 1.0, 0.0])
    number = torch.arange(verts.shape[1])
    edges = [edges_of(f[f[:, 0] != f[:, 1]]) for f in shape.faces]
    room_for = max(map(len, edges)) + 5
    edges = [torch.cat([e, e.new_zeros(room_for - len(e), 4)]) for e in edges]
    last = shape.faces.flatten(1).amax(1)
    objects = replace(
        inputs.objects, verts=verts.float(), real_verts=number <= last[:, None],
        faces=shape.faces, edges=torch.stack(edges),
    )  # fmt: skip
    at = Layout(*(getattr(inputs.starts, f.name)[0] for f in fields(Layout)))
    image = replace(
        image_at(objects, at, inputs.camera, size), distance=at.t_world_object.norm(dim=-1),
        walls=walls_at(objects, at),
    )  # fmt: skip
    humans = humans_at(objects, at, inputs.camera, image)
    inputs = replace(inputs, objects=objects, image=image, humans=humans)
    return with_trees(replace(inputs, **changes))


def starts_of(inputs, count=3, amount=0.1):
    """Some layouts about the truth."""
    many = [moved(inputs.starts, seed, amount) for seed in range(count)]
    return Layout(*(torch.cat([getattr(m, f.name) for m in many]) for f in fields(Layout)))


def both(inputs, weights=WEIGHTS):
    """The energy by one kernel, and term by term."""
    config = SceneConfig(weights, "robust", GROWTH)
    rest = inputs.objects, inputs.camera, inputs.image, inputs.humans, config
    fast = energy_function(*rest)
    assert fast(inputs.starts).whole is not None
    return fast, lambda layout: scene_energy(layout, *rest)


def told(energy, layout, term=None):
    """Energy, or one term, of each item, and its gradient in one row for each item."""
    free = Layout(*(getattr(layout, f.name).clone().requires_grad_() for f in fields(Layout)))
    found = energy(free)
    value = found.per_item if term is None else found.parts[term]
    slopes = torch.autograd.grad(
        value.sum(),
        [free.t_world_object, free.yaw, free.log_scale],
        allow_unused=True,
        materialize_grads=True,
    )
    return value.detach(), torch.cat([slopes[0], slopes[1].unsqueeze(-1), slopes[2]], -1)


def agree(fast, slow, layout, term=None):
    """Values to 1e-5, gradients of all items together to 1e-3."""
    (value, slope), (truth, exact) = told(fast, layout, term), told(slow, layout, term)
    torch.testing.assert_close(value, truth, rtol=1e-5, atol=1e-5)
    assert (slope - exact).norm() <= 1e-3 * exact.norm() + 1e-6
    return value


class TestAgreement:
    @pytest.mark.parametrize("size", [33, 64, 130])
    @pytest.mark.parametrize("term", TERMS)
    def test_each_term_and_its_gradient_are_those_of_the_term_itself(self, term, size):
        inputs = room(size)
        fast, slow = both(inputs)
        value = agree(fast, slow, starts_of(inputs), term)
        assert term == "collision" or float(value.sum()) > 0

    def test_their_sum_is_the_energy_and_missing_weights_leave_no_term(self):
        inputs = room()
        fast, slow = both(inputs, replace(WEIGHTS, depth=0.0, contact=0.0))
        layout = starts_of(inputs)
        assert set(fast(layout).parts) == set(slow(layout).parts)
        agree(fast, slow, layout)

    def test_lines_that_nobody_knows_leave_no_term(self):
        inputs = room()
        inputs = replace(inputs, image=replace(inputs.image, walls=None))
        fast, slow = both(inputs)
        layout = starts_of(inputs)
        assert set(fast(layout).parts) == set(slow(layout).parts) == set(TERMS) - {"wall"}
        agree(fast, slow, layout)

    @pytest.mark.parametrize("parts", [False, True])
    def test_so_is_what_another_rotation_of_the_camera_costs_and_its_gradient(self, parts):
        inputs = room(130)
        weights = replace(WEIGHTS, collision=0.0, contact=0.0, wall=0.0, heading=0.0)
        fast, _ = both(inputs, weights)
        rest, layout = (inputs.image, inputs.humans), starts_of(inputs)
        before = fast(layout).per_item
        tilt = torch.tensor([0.02, -0.03, 0.01])
        found = []
        for way in (
            fast,
            lambda layout, turn: scene_energy(
                layout, inputs.objects, replace(inputs.camera, R_cam_world=turn), *rest,
                SceneConfig(weights, "robust", GROWTH),
            ),
        ):  # fmt: skip
            free = tilt.clone().requires_grad_()
            energy = way(layout, axis_angle(free) @ inputs.camera.R_cam_world)
            each = energy.per_item
            told = torch.stack(list(energy.parts.values())).sum(0) if parts else each
            (slope,) = torch.autograd.grad(told.sum(), free)
            found.append((each.detach(), slope))
        torch.testing.assert_close(found[0][0], found[1][0], rtol=1e-5, atol=1e-5)
        assert (found[0][1] - found[1][1]).norm() <= 1e-3 * found[1][1].norm()
        assert not torch.allclose(found[0][0], before)
        assert torch.equal(fast(layout).per_item, before)

    def test_some_rows_of_the_starts_cost_what_they_cost_among_all(self):
        inputs = room()
        rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
        fast, layout = both(inputs)[0], starts_of(inputs)
        value, slope = (x.flatten(0, 1) for x in told(fast, layout))
        some = energy_of_rows(*rest, SceneConfig(WEIGHTS, "robust", GROWTH))
        for numbers in ([4], [8, 0, 5], [5, 0], list(range(9)), [7, 1, 2, 3]):
            rows = torch.tensor(numbers)
            few = Layout(*(getattr(layout, f.name).flatten(0, 1)[rows] for f in fields(Layout)))
            found = told(some(rows), few)
            assert torch.equal(found[0], value[rows])
            assert torch.equal(found[1], slope[rows])

    @pytest.mark.parametrize("shift", [(0.0, 0.0, 2.5), (0.0, 0.0, 9.0), (40.0, 0.0, 0.0)])
    def test_so_are_those_of_objects_before_behind_and_beside_the_camera(self, shift):
        inputs = room()
        layout = starts_of(inputs)
        away = replace(layout, t_world_object=layout.t_world_object + torch.tensor(shift))
        value = agree(*both(inputs), away)
        assert value.isfinite().all()

    def test_bounds_on_few_pixels_count_there_only(self):
        inputs = room()
        depth = inputs.humans.depth
        assert depth is not None
        few = torch.zeros_like(depth.near, dtype=torch.bool)
        few[0, 20:40, 30:50] = few[2, 31, 32] = True
        near = torch.where(few, 4.0, -torch.inf)
        bounds = DepthRange(near, torch.full_like(near, torch.inf), depth.area)
        inputs = replace(inputs, humans=replace(inputs.humans, depth=bounds))
        value = agree(*both(inputs), starts_of(inputs), "depth")
        assert (value[:, 1] == 0).all()
        assert (value[:, 0] > 0).all()

    def test_unknown_pixels_weak_trust_and_fractional_masks_are_heard(self):
        inputs = room()
        image = inputs.image
        keep = image.keep.clone()
        keep[:, :, 20:40] = False
        masks = torch.nn.functional.avg_pool2d(image.masks, 5, 1, 2)
        sides = image.sides.clone()
        sides[0, 1] = sides[1] = UNKNOWN
        sides[2, ::2] = sides[0, 2] = LEAST
        sides[2, 1] = sides[0, 3] = LIKELY
        trust = torch.tensor([0.2, 1.0, 0.7])
        image = replace(image, keep=keep, masks=masks, sides=sides, trust=trust)
        inputs = replace(inputs, image=image)
        fast, slow = both(inputs)
        for term in ("silhouette", "bbox"):
            agree(fast, slow, starts_of(inputs), term)

    def test_sizes_far_from_the_usual_cost_what_they_should(self):
        inputs = room()
        layout = starts_of(inputs)
        wide = replace(layout, log_scale=torch.linspace(-0.8, 0.8, layout.log_scale.numel())
                       .view_as(layout.log_scale))  # fmt: skip
        agree(*both(inputs), wide, "scale")


class TestRepetition:
    def test_any_number_of_threads_and_any_history_give_the_same_bits(self):
        inputs = room()
        layout, other = starts_of(inputs), starts_of(inputs, 5, 0.3)
        runs = []
        for threads in (1, 2, 3):
            fast, _ = both(inputs)
            with use_threads(threads):
                for _ in range(2):
                    runs.append(told(fast, layout))
                    told(fast, other)
        for run in runs[1:]:
            for values, expected in zip(run, runs[0], strict=True):
                assert torch.equal(values, expected)

    def test_a_start_costs_the_same_whatever_else_is_priced(self):
        inputs = room()
        fast, _ = both(inputs)
        many = starts_of(inputs, 4)
        one = Layout(*(getattr(many, f.name)[2] for f in fields(Layout)))
        assert torch.equal(fast(many).per_item[2], fast(one).per_item)


class TestWhoPrices:
    def test_double_precision_other_forms_and_torch_are_priced_term_by_term(self):
        layout = starts_of(room())
        inputs = room()
        rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
        assert energy_function(*rest, SceneConfig(WEIGHTS, "paper"))(layout).whole is None
        assert energy_function(*rest, SceneConfig(WEIGHTS, "robust"))(layout).whole is not None
        with use_engine("torch"):
            assert energy_function(*rest, SceneConfig(WEIGHTS, "robust"))(layout).whole is None
        double = make_inputs(torch.float64, size=16)
        rest = double.objects, double.camera, double.image, double.humans
        assert energy_function(*rest, SceneConfig(WEIGHTS, "robust"))(double.starts).whole is None

    def test_an_open_mesh_is_priced_term_by_term(self):
        inputs = room()
        faces = inputs.objects.faces.clone()
        faces[0, 3] = 0
        objects = replace(inputs.objects, faces=faces)
        config = SceneConfig(WEIGHTS, "robust")
        energy = energy_function(objects, inputs.camera, inputs.image, inputs.humans, config)
        assert energy(inputs.starts).whole is None


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
