"""What `benchmarks/calibrate.py` learns, on doubts and errors that are drawn by a known rule."""

import sys
from pathlib import Path

import torch

from mover.core.explanation import Facts
from mover.evaluate.calibration import GROWING, MISFIT
from mover.evaluate.explanation import explain, ways_of

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from calibrate_learn import Judged, held, in_turn, learn

FACTORS = {"distance": 0.5, "sideways": 0.2, "yaw": 0.4, "size": 0.3}
POWERS = {"distance": 1.0, "sideways": 2.0, "yaw": 1.5, "size": 0.0}
WAYS = {"distance": (2,), "sideways": (0,), "yaw": (3,), "size": (4, 5, 6)}  # ahead is along -z


def drawn(seed: int, objects: int = 150) -> Judged:
    """Objects straight ahead whose errors are as the rule says; the floor is exact."""
    g = torch.Generator().manual_seed(seed)
    facts, truth = list[Facts](), list[torch.Tensor]()
    for k in range(objects):
        place = torch.tensor([0.0, -1.4, -5.0, 0.3, 0, 0, 0], dtype=torch.float64)
        spread = 0.02 + 0.08 * torch.rand(7, generator=g, dtype=torch.float64)
        overlap = 1 - 0.6 * float(torch.rand((), generator=g))
        tilt = torch.zeros(7, 7, dtype=torch.float64)
        tilt[1, 1] = 1e-6
        facts.append(
            Facts(str(k), 0.1, place, torch.diag(spread**2), tilt, torch.zeros_like(tilt), (), (),
                  (), None, (), overlap, (), "ground", False)
        )  # fmt: skip
        error = 1e-3 * torch.randn(7, generator=g, dtype=torch.float64)
        for kind, columns in WAYS.items():
            grown = FACTORS[kind] * (1 + (1 - overlap) / MISFIT) ** POWERS[kind]
            for column in columns:
                draw = torch.randn((), generator=g, dtype=torch.float64)
                error[column] = grown * spread[column] * draw
        truth.append(place + error)
    return Judged(tuple(facts), torch.stack(truth))


def test_the_rule_that_errors_were_drawn_by_is_learnt_and_holds_for_others():
    known = learn([drawn(seed) for seed in range(3)])
    assert set(known.powers) == set(GROWING)
    for kind, power in POWERS.items():
        assert abs(known.powers[kind] - power) <= 0.5, kind
    room = drawn(7, 400)
    told = explain(room.facts, known)
    for kind, columns in WAYS.items():
        ways = torch.eye(7, dtype=torch.float64)[list(columns)]
        pairs = zip(told, room.truth, strict=True)
        good = [held(e, way, t) for e, t in pairs for way in ways]
        assert 0.85 <= sum(good) / len(good) <= 0.95, kind
    assert abs(float(ways_of(room.facts[0].place)[0, 2])) == 1  # along the ray is along z


def test_what_is_learnt_for_a_group_is_learnt_on_the_others():
    groups = [[drawn(1, 40)], [drawn(2, 40), drawn(3, 40)], [drawn(4, 40)]]
    found = in_turn(groups)
    assert len(found) == 3
    assert found[1] == learn([drawn(1, 40), drawn(4, 40)])
