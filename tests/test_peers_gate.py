"""The benchmarks' gate fails where quality is worse than the baseline, and only there."""

import json
import math
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

from gate import SLOWER, judge  # noqa: E402

BASELINE = json.loads((BENCHMARKS / "baseline.json").read_text())
QUALITY = {name: held["value"] for name, held in BASELINE["quality"].items()}
TIMES = {name: held["wall"] for name, held in BASELINE["times"].items()}


def test_the_baseline_passes_its_own_gate():
    assert judge(QUALITY, TIMES, BASELINE) == ([], [])


@pytest.mark.parametrize("name", QUALITY)
def test_a_worse_figure_fails_and_one_within_its_tolerance_passes(name: str):
    held = BASELINE["quality"][name]
    for share, fails in ((0.9, 0), (1.1, 1), (math.nan, 1), (-1.0, 0)):
        value = held["value"] + share * held["tolerance"]
        assert len(judge(QUALITY | {name: value}, TIMES, BASELINE).failures) == fails


def test_an_absent_figure_fails_unless_it_needs_an_optional_package():
    for name, held in BASELINE["quality"].items():
        rest = {n: v for n, v in QUALITY.items() if n != name}
        assert bool(judge(rest, TIMES, BASELINE).failures) != bool(held.get("optional"))


def test_time_only_warns():
    slow = {name: 2 * SLOWER * wall for name, wall in TIMES.items()}
    failures, warnings = judge(QUALITY, slow, BASELINE)
    assert failures == []
    assert len(warnings) == len(TIMES) > 0
