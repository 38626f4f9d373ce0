"""Second-order descents: known minima, independent problems, honest ends; Eq. 1 through them."""

from dataclasses import replace

import pytest
import torch
from analytic import make_inputs, moved
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.app.cli.run import parse_run
from mover.core.observe import Energy, silent
from mover.core.records import plain, record
from mover.core.settings import read_settings
from mover.core.types import Layout
from mover.energy.bfgs import Problems, _step, minimize_batched
from mover.energy.config import Adam, BatchedBFGS, SceneWeights
from mover.energy.fused import energy as energy_warp
from mover.energy.image_terms import silhouette_term
from mover.geometry.camera import outermost, project, to_camera
from mover.geometry.placement import place, place_in
from mover.pipeline.presets import Config
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_objects import descend, energy_of, place_objects

EXACT = BatchedBFGS(steps=400, gain=1e-12, least=1e-9, patience=10)


@record
class Point:
    """Unknowns in two fields, as a layout has them."""

    x: torch.Tensor
    y: torch.Tensor


def bowls(n, seed=0):
    """Curved bowls with known bottoms; condition up to 10^4."""
    r = torch.Generator().manual_seed(seed)
    axes, _ = torch.linalg.qr(torch.randn(n, 3, 3, generator=r).double())
    curve = 10 ** (4 * torch.rand(n, 3, generator=r).double())
    bottom = torch.randn(n, 3, generator=r).double()

    def of(rows):
        def energy(p):
            at = torch.cat([p.x[:, None], p.y], -1) - bottom[rows]
            along = (axes[rows] * at[:, :, None]).sum(1)
            return Energy({"bowl": 0.5 * (curve[rows] * along.square()).sum(-1)})

        return energy

    start = Point(torch.zeros(n).double(), torch.zeros(n, 2).double())
    return Problems(of, start, (n,)), bottom


def valleys(n, seed=0):
    """Rosenbrock's function, a = 1, with valleys of different steepness."""
    steep = 10 ** torch.linspace(0.5, 2, n).double()
    r = torch.Generator().manual_seed(seed)
    start = Point(torch.randn(n, generator=r).double(), torch.randn(n, 1, generator=r).double())

    def of(rows):
        return lambda p: Energy({
            "far": (1 - p.x).square(),
            "off": steep[rows] * (p.y[:, 0] - p.x.square()).square(),
        })  # fmt: skip

    return Problems(of, start, (n,))


def test_duplicates_are_solved_once():
    some, like = valleys(4), torch.tensor([0, 1, 0, 3, 1, 3])
    start = Point(some.start.x[like], some.start.y[like])
    asked: list[int] = []

    def of(rows):
        asked.extend(rows.tolist())
        return some.of(like[rows])

    apart = minimize_batched(Problems(of, start, (6,)), BatchedBFGS())
    assert {*asked} == {*range(6)}
    asked.clear()
    found = minimize_batched(
        Problems(of, start, (6,), None, torch.tensor([0, 1, 0, 3, 1, 3])), BatchedBFGS()
    )
    assert {*asked} == {0, 1, 3}
    for a, b in ((found.at.x, apart.at.x), (found.at.y, apart.at.y), (found.value, apart.value)):
        assert torch.equal(a, b)
    assert torch.equal(found.trace, apart.trace)


def test_bottoms_of_bowls_are_found():
    problems, bottom = bowls(20)
    found = minimize_batched(problems, EXACT)
    at = torch.cat([found.at.x[:, None], found.at.y], -1)
    torch.testing.assert_close(at, bottom, rtol=0, atol=1e-4)


def test_the_end_of_each_of_rosenbrocks_valleys_is_found():
    found = minimize_batched(valleys(12), EXACT)
    assert float(found.value.max()) < 1e-8
    torch.testing.assert_close(found.at.x, torch.ones(12).double(), rtol=0, atol=1e-3)


@pytest.mark.parametrize("k", [0, 3, 11])
def test_a_problem_goes_its_way_whatever_else_is_in_the_batch(k):
    many = valleys(12)
    start = Point(many.start.x[k : k + 1], many.start.y[k : k + 1])
    alone = Problems(lambda rows: many.of(rows + k), start, (1,))
    together, one = (minimize_batched(some, BatchedBFGS()) for some in (many, alone))
    torch.testing.assert_close(one.at.x[0], together.at.x[k], rtol=0, atol=1e-6)
    torch.testing.assert_close(one.value[0], together.value[k], rtol=1e-6, atol=1e-9)


def test_what_has_converged_leaves_the_batch_and_the_rest_goes_on():
    problems = valleys(12)
    sizes = []

    def of(rows):
        energy = problems.of(rows)

        def counted(p):
            sizes.append(len(p.x))
            return energy(p)

        return counted

    steps = []
    found = minimize_batched(replace(problems, of=of), BatchedBFGS(steps=500), steps.append)
    assert sizes[0] == 12
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < 12
    assert len(sizes) < 300
    assert len(found.trace) == len(sizes)
    assert steps[-1].index + 1 == steps[-1].steps


@given(seed=st.integers(0, 2**20), steps=st.integers(0, 12))
@settings(max_examples=25, deadline=None)
def test_no_problem_ends_higher_than_it_starts_and_the_trace_falls(seed, steps):
    """Also where the surface is torn into terraces with slopes that mislead."""
    r = torch.Generator().manual_seed(seed)
    wild = torch.randn(6, 3, generator=r).double() * 20

    def of(rows):
        def energy(p):
            at = torch.cat([p.x[:, None], p.y], -1)
            terrace = (at * 9).floor().detach().sum(-1).abs() / 9
            return Energy({"rough": (at * wild[rows]).sin().sum(-1) + at.abs().sum(-1) + terrace})

        return energy

    start = Point(torch.randn(6, generator=r).double(), torch.randn(6, 2, generator=r).double())
    problems = Problems(of, start, (6,))
    found = minimize_batched(problems, BatchedBFGS(steps=steps))
    before = of(torch.arange(6))(start).per_item
    assert (found.value <= before).all()
    assert (found.trace.diff() <= 0).all()
    there = of(torch.arange(6))(found.at).per_item
    torch.testing.assert_close(there, found.value, rtol=0, atol=0)


def test_an_energy_that_is_not_finite_at_the_start_is_an_error():
    problems, _ = bowls(3)
    start = Point(problems.start.x * torch.nan, problems.start.y)
    with pytest.raises(ValueError, match="somewhere: the energy is not finite"):
        minimize_batched(replace(problems, start=start), BatchedBFGS(), silent, "somewhere")


def test_a_cliff_of_nan_is_not_stepped_over():
    def of(_rows):
        return lambda p: Energy({"cliff": torch.where(p.x < 0.3, -p.x, torch.nan) + 0 * p.y[:, 0]})

    start = Point(torch.zeros(1).double(), torch.zeros(1, 1).double())
    found = minimize_batched(Problems(of, start, (1,)), BatchedBFGS())
    assert 0.2 < float(found.at.x) < 0.3


@pytest.mark.parametrize("radius", [1e-6, 0.1, 1.0, 1e4])
def test_a_step_is_the_least_of_its_model_within_the_radius(radius):
    """The conditions of Moré and Sorensen: (B + k I) s = -g, k >= 0, k (r - |s|) = 0."""
    r = torch.Generator().manual_seed(2)
    axes, _ = torch.linalg.qr(torch.randn(40, 7, 7, generator=r).double())
    curve = 10 ** (8 * torch.rand(40, 7, generator=r).double() - 4)
    model, slope = axes * curve[:, None] @ axes.mT, torch.randn(40, 7, generator=r).double()
    slope[0] = 0.0
    step, promise = _step(model, slope, torch.full((40,), radius, dtype=torch.float64))
    length, pull = step.norm(dim=-1), -(slope + (model @ step[..., None])[..., 0])
    assert (length <= radius * (1 + 1e-9)).all()
    inside = length < radius * (1 - 1e-6)
    scale = slope.norm(dim=-1)
    assert (pull[inside].norm(dim=-1) <= 1e-6 * scale[inside] + 1e-9).all()
    along = (pull * step).sum(-1)
    assert (along >= -1e-7 * scale * length).all()
    across = pull - (along / length.square().clamp_min(1e-300))[:, None] * step
    assert (across.norm(dim=-1) <= 1e-4 * scale + 1e-12).all()
    promised = -(slope * step).sum(-1) - 0.5 * (step * (model @ step[..., None])[..., 0]).sum(-1)
    torch.testing.assert_close(promise, promised, rtol=1e-6, atol=1e-9)


def test_grouped_problems_decide_together():
    """The first one's unknown rules the second one's energy: alone it would raise the sum."""

    def of(_rows):
        def energy(p):
            first = torch.stack([-p.x[0], 3 * p.x[0] + p.x[1].square()])
            return Energy({"pair": first + p.x.square() + 0 * p.y[:, 0]})

        return energy

    start = Point(torch.zeros(2).double(), torch.zeros(2, 1).double())
    found = minimize_batched(Problems(of, start, (2,), torch.zeros(2).long()), EXACT)
    torch.testing.assert_close(found.at.x, torch.tensor([-1.0, 0.0]).double(), rtol=0, atol=1e-4)


WEIGHTS = SceneWeights(1.0, 1.0, 0.3, 0.2, 0.1, 0.2, heading=0.1)
ROBUST = PlaceConfig(WEIGHTS, "robust", BatchedBFGS())


class TestPlacing:
    def test_it_ends_no_higher_than_adam_from_the_same_start(self):
        inputs = make_inputs(size=32)
        starts = moved(inputs.starts, 3, 0.1)
        adam = descend(
            inputs, ROBUST, starts, Adam(60, 0.02, 0.002, beta2=0.98, keep_best=True), silent
        )
        fast = descend(inputs, ROBUST, starts, BatchedBFGS(), silent)
        assert (fast.value <= adam.value * 1.05 + 1e-3).all()

    def test_each_start_of_each_object_ends_where_it_ends_alone(self):
        inputs = make_inputs(size=32)
        many = [moved(inputs.starts, s, 0.1) for s in range(3)]
        batch = Layout.cat(*many)
        together = descend(inputs, ROBUST, batch, BatchedBFGS(steps=5), silent)
        one = descend(inputs, ROBUST, many[1], BatchedBFGS(steps=5), silent)
        torch.testing.assert_close(together.value[1:2], one.value, rtol=1e-3, atol=1e-5)

    def test_the_evidence_is_prepared_once_whatever_leaves_the_batch(self, monkeypatch):
        pytest.importorskip("warp")
        inputs, packed = make_inputs(size=32), []
        prepare = energy_warp.kernel_of
        monkeypatch.setattr(energy_warp, "kernel_of", lambda *a: packed.append(a) or prepare(*a))
        descend(
            inputs, ROBUST, moved(inputs.starts, 1, 0.1), BatchedBFGS(steps=8, patience=1), silent
        )
        assert len(packed) == 1

    def test_a_load_moves_with_what_carries_it(self):
        inputs = make_inputs(size=32)
        supports = inputs.objects.supports.clone()
        supports[1] = 0
        inputs = replace(inputs, objects=replace(inputs.objects, supports=supports))
        starts = moved(inputs.starts, 2, 0.1)
        found = descend(inputs, ROBUST, starts, BatchedBFGS(steps=6), silent)
        before = energy_of(inputs, ROBUST)(starts).per_item
        assert (found.value[:, :2].sum(1) <= before[:, :2].sum(1)).all()
        there = energy_of(inputs, ROBUST)(found.at).per_item
        torch.testing.assert_close(found.value, there, rtol=1e-4, atol=1e-6)

    def test_coarse_short_descents_choose_among_turned_starts(self):
        inputs = make_inputs(size=32)
        inputs = replace(inputs, starts=moved(inputs.starts, 4, 0.1)[:1])
        quick = replace(ROBUST, yaws=4, short=BatchedBFGS(steps=6), num_hypotheses=2, coarse=2)
        assert place_objects(inputs, quick).layout.yaw.isfinite().all()


class TestCommandLine:
    def test_steps_of_each_method_are_set_by_flags(self):
        flags = ["--place.method.steps", "9", "--layout.method.steps", "3"]
        run, config = parse_run(["room", *flags])
        assert run.source.name == "room"
        assert config.place.method == BatchedBFGS(steps=9)
        assert config.layout.method == BatchedBFGS(steps=3)
        _, config = parse_run(["room", *flags, "--preset", "paper"])
        assert config.place.method == Adam(9)

    def test_settings_come_back_from_a_file_with_the_right_method(self):
        for preset in ("robust", "paper"):
            _, config = parse_run(["room", "--preset", preset])
            again = read_settings(Config, plain(config), "config")
            assert again.place.method == config.place.method
            assert again.layout.method == config.layout.method


class TestFasterTerms:
    """What was made faster against the plain way to compute it."""

    def test_squares_are_those_of_autograd_and_as_steep_as_the_renderer(self):
        r = torch.Generator().manual_seed(7)
        free = torch.rand(2, 3, 24, 24, generator=r).double().requires_grad_()
        mask, keep = torch.rand(2, 3, 24, 24, generator=r).double().unbind()
        plain_ = ((free - mask).square() * (keep < 0.7)).sum((-2, -1))
        fast = silhouette_term(free, mask, keep < 0.7, "paper")
        torch.testing.assert_close(fast, plain_)
        one, two = (torch.autograd.grad(p.square().sum(), free)[0] for p in (plain_, fast))
        torch.testing.assert_close(12 * one, two)

    def test_points_are_placed_in_camera_axes_by_one_matrix(self):
        inputs = make_inputs(torch.float64, size=16)
        layout, R = moved(inputs.starts, 1, 0.4), inputs.camera.R_cam_world
        one = place_in(inputs.objects.verts, layout, R)
        two = to_camera(place(inputs.objects.verts, layout), R)
        torch.testing.assert_close(one, two)

    def test_the_outermost_points_have_the_extent_of_all(self):
        points = torch.randn(2, 3, 50, 3, generator=torch.Generator().manual_seed(0))
        points = points + torch.tensor([0.0, 0.0, 4.0])
        K = torch.tensor([[300.0, 0, 100], [0, 300, 80], [0, 0, 1]])
        few, every = project(outermost(points, K), K), project(points, K)
        torch.testing.assert_close(few.amin(-2), every.amin(-2), rtol=0, atol=0)
        torch.testing.assert_close(few.amax(-2), every.amax(-2), rtol=0, atol=0)
