"""The cost of sizes that a room teaches, against the normal distribution that it stands for."""

from dataclasses import dataclass, field, replace

import pytest
import torch
from kept_rooms import thinned
from test_pipeline import light

from mover.core.run import Run
from mover.core.types import Layout
from mover.energy.config import SceneWeights
from mover.energy.prior_terms import scale_term
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import SpreadConfig
from mover.stages.objects.gather_given import WIDEST, estimate_size_prior, inlier_weights
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise

USUAL, COMMON = 0.07, 0.045
CONFIG = SpreadConfig(usual=USUAL, common=COMMON, known=0.0)
GROWTH = 3 * USUAL**2 / (USUAL**2 + 3 * COMMON**2)
"""Cost of growing as a whole, of the normal distribution with the usual spread."""


def layout_of(log_scale: torch.Tensor) -> Layout:
    count = len(log_scale)
    return Layout(torch.zeros(count, 3), torch.zeros(count), log_scale)


def taught(log_scale: torch.Tensor, config: SpreadConfig) -> tuple[float, float]:
    """What pieces teach whose shapes are all right."""
    return estimate_size_prior(layout_of(log_scale), torch.ones(len(log_scale)), config)


def drawn(spread: float, count: int = 4000) -> torch.Tensor:
    """Logarithms of sizes as the model has them: something common, and each its own."""
    r = torch.Generator().manual_seed(7)
    common = COMMON * torch.randn(count, 1, generator=r)
    return common + spread * torch.randn(count, 3, generator=r)


@pytest.mark.parametrize("spread", [0.07, 0.1, 0.15])
def test_the_cost_is_that_of_the_normal_distribution_the_room_was_drawn_from(spread: float):
    shape, whole = taught(drawn(spread), CONFIG)
    within = (torch.rand(50, 3) - 0.5) * 0.6  # no size beyond 0.6 or 1.6
    cost = shape * scale_term(within, "robust", GROWTH * whole / shape)
    covariance = spread**2 * torch.eye(3) + COMMON**2 * torch.ones(3, 3)
    normal = (within @ torch.linalg.inv(covariance) * within).sum(-1)
    torch.testing.assert_close(cost, USUAL**2 * normal, rtol=0.06, atol=0)


COMMON_SIZES = 0.4 * torch.randn(30, 1, generator=torch.Generator().manual_seed(0)).expand(30, 3)
NOTHING_NEW = {
    "no spread": (drawn(0.0), CONFIG), "less than usual": (drawn(0.03), CONFIG),
    "nearly the usual": (drawn(0.065), CONFIG), "what is common to a piece": (COMMON_SIZES, CONFIG),
    "the paper": (drawn(0.2, 8), PRESETS["paper"].sizes),
    "no furniture": (torch.zeros(0, 3), SpreadConfig(0.07)),
}  # fmt: skip


@pytest.mark.parametrize("name", NOTHING_NEW)
def test_what_teaches_nothing_leaves_the_usual_cost(name: str):
    assert taught(*NOTHING_NEW[name]) == (1, 1)


def test_one_wild_piece_among_few_is_held_by_what_is_usual_and_never_beyond_a_limit():
    one = torch.tensor([[0.3, -0.3, 0.0]])
    assert taught(one, CONFIG)[0] == pytest.approx(1 / WIDEST**2)
    found = (4 * USUAL**2 + 0.09) / 5  # 0.3^2 + 0.3^2 of two degrees of freedom
    held = taught(one, replace(CONFIG, known=4.0))
    assert held[0] == pytest.approx(USUAL**2 / found)
    assert held[1] == pytest.approx((USUAL**2 + 3 * COMMON**2) / (found + 3 * COMMON**2))


def test_pieces_whose_silhouettes_cannot_be_made_to_fit_teach_hardly_anything():
    right = drawn(0.1)
    wrong = 0.5 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(3))
    trust = inlier_weights(torch.tensor([0.02, 5.0]).repeat_interleave(4000))
    assert trust.unique().tolist() == pytest.approx([0.1, 1])
    shape, _ = estimate_size_prior(layout_of(torch.cat([right, wrong])), trust, CONFIG)
    assert USUAL**2 / shape == pytest.approx((0.1**2 + 0.01 * 0.5**2) / 1.01, rel=0.05)


def test_a_silhouette_is_weighted_less_the_worse_it_can_be_made_to_fit():
    trust = inlier_weights(torch.tensor([0.0, 0.05, 0.1, 0.2, 0.4, 3.0]))
    torch.testing.assert_close(trust, torch.tensor([1, 1, 1, 0.5, 0.25, 0.1]))


@dataclass(frozen=True)
class Weighing(Run):
    """Keeps what sizes cost in each stage that weighs them."""

    weighed: list[tuple[str, float, float]] = field(default_factory=list)

    def stage(self, fn, inputs, config):
        weights = getattr(config, "weights", None)
        if isinstance(weights, SceneWeights):
            self.weighed.append((fn.__name__, weights.scale, config.uniform_scale_weight))
        return super().stage(fn, inputs, config)


@pytest.mark.slow
def test_all_stages_after_the_first_trust_wrong_sizes_less(small_room, tmp_path):
    run, config = Weighing(tmp_path), light("robust")
    reconstruct(thinned(add_noise(small_room, NoiseConfig(scale=0.35), 1)), config, run)
    names, scales, growths = zip(*run.weighed, strict=True)
    rounds = ["refine_camera", "place_objects"] * config.refine.rounds
    assert names == ("place_objects", *rounds, *["place_objects"] * 2)
    assert (scales[0], growths[0]) == (config.layout.weights.scale, 1.5)
    assert len(set(scales[1:])) == len(set(growths[1:])) == 1
    assert scales[1] < 0.7 * scales[0]
    assert growths[1] > growths[0]
