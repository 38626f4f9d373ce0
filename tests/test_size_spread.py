"""The price of sizes that a room teaches, against the normal distribution that it stands for."""

import math
from dataclasses import dataclass, field, replace

import pytest
import torch
from test_pipeline import light

from mover.energy import SceneWeights
from mover.pipeline import Run, reconstruct
from mover.presets import PRESETS
from mover.rooms.noise import NoiseConfig, add_noise
from mover.stages.size_spread import SpreadConfig, learnt_sizes
from mover.terms.scale import scale_term
from mover.types import Layout

USUAL, COMMON = 0.07, 0.045
CONFIG = SpreadConfig(usual=USUAL, common=COMMON, known=0.0)
WEIGHTS = SceneWeights(
    1.0, 1.0, 0.3, growth=3 * USUAL**2 / (USUAL**2 + 3 * COMMON**2)
)  # the normal distribution with the usual spread


def layout_of(log_scale: torch.Tensor) -> Layout:
    count = len(log_scale)
    return Layout(torch.zeros(count, 3), torch.zeros(count), log_scale)


def drawn(spread: float, count: int = 4000) -> torch.Tensor:
    """Logarithms of sizes as the model has them: something common, and each its own."""
    r = torch.Generator().manual_seed(7)
    common = COMMON * torch.randn(count, 1, generator=r)
    return common + spread * torch.randn(count, 3, generator=r)


def price_of(weights: SceneWeights, log_scale: torch.Tensor) -> torch.Tensor:
    return weights.scale * scale_term(log_scale, "robust", weights.growth)


@pytest.mark.parametrize("spread", [0.07, 0.1, 0.15])
def test_the_price_is_that_of_the_normal_distribution_the_room_was_drawn_from(spread: float):
    weights = learnt_sizes(WEIGHTS, layout_of(drawn(spread)), CONFIG)
    within = (torch.rand(50, 3) - 0.5) * 0.6  # no size beyond 0.6 or 1.6
    covariance = spread**2 * torch.eye(3) + COMMON**2 * torch.ones(3, 3)
    normal = (within @ torch.linalg.inv(covariance) * within).sum(-1)
    unit = 0.3 * USUAL**2  # of the usual price
    torch.testing.assert_close(price_of(weights, within), unit * normal, rtol=0.06, atol=0)


@pytest.mark.parametrize("spread", [0.0, 0.03, 0.065])
def test_less_than_the_usual_spread_changes_nothing(spread: float):
    assert learnt_sizes(WEIGHTS, layout_of(drawn(spread)), CONFIG) == WEIGHTS


def test_what_is_common_to_the_sizes_of_a_piece_teaches_nothing():
    whole = 0.4 * torch.randn(30, 1, generator=torch.Generator().manual_seed(0))
    assert learnt_sizes(WEIGHTS, layout_of(whole.expand(30, 3)), CONFIG) == WEIGHTS


def test_one_wild_piece_among_few_is_held_by_what_is_usual_and_never_believed_beyond_a_limit():
    one = torch.tensor([[0.3, -0.3, 0.0]])
    alone = learnt_sizes(WEIGHTS, layout_of(one), CONFIG)
    held = learnt_sizes(WEIGHTS, layout_of(one), replace(CONFIG, known=4.0))
    assert math.isclose(alone.scale, WEIGHTS.scale / CONFIG.most**2, rel_tol=1e-6)
    found = (4 * USUAL**2 + 0.09) / 5  # 0.3^2 + 0.3^2 of two degrees of freedom
    assert math.isclose(held.scale, WEIGHTS.scale * USUAL**2 / found, rel_tol=1e-5)


def test_only_the_price_of_sizes_changes_and_only_where_it_is_asked_for():
    wild = layout_of(drawn(0.2, 8))
    found = learnt_sizes(WEIGHTS, wild, CONFIG)
    assert found != WEIGHTS
    assert replace(found, scale=WEIGHTS.scale, growth=WEIGHTS.growth) == WEIGHTS
    for name in ("paper", "release"):
        assert learnt_sizes(WEIGHTS, wild, PRESETS[name].sizes) is WEIGHTS


def test_a_room_without_furniture_has_the_usual_price():
    assert learnt_sizes(WEIGHTS, layout_of(torch.zeros(0, 3)), SpreadConfig(0.07)) == WEIGHTS


@dataclass(frozen=True)
class Weighing(Run):
    """Keeps the weights of each stage that has some."""

    heard: list[tuple[str, SceneWeights]] = field(default_factory=list)

    def stage(self, fn, inputs, config):
        weights = getattr(config, "weights", None)
        if isinstance(weights, SceneWeights):
            self.heard.append((fn.__name__, weights))
        return super().stage(fn, inputs, config)


@pytest.mark.slow
def test_all_stages_after_the_first_believe_wrong_sizes_less(small_room, tmp_path):
    run, config = Weighing(tmp_path), light("robust")
    reconstruct(add_noise(small_room, NoiseConfig(scale=0.35), 1), config, run)
    names, weights = zip(*run.heard, strict=True)
    assert names == ("place_objects", "refine_camera", *["place_objects"] * 3)
    assert weights[0] == config.layout.weights
    assert len({w.scale for w in weights[1:]}) == 1
    assert weights[1].scale < 0.7 * weights[0].scale
    assert weights[1].growth > weights[0].growth
