"""The benchmarks' gate fails where quality is worse than the baseline, and only there."""

import json
import math
import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import peers  # noqa: E402
import peers_rows  # noqa: E402
import peers_tools  # noqa: E402
from gate import SLOWER, held, judge  # noqa: E402

BASELINE = json.loads((BENCHMARKS / "baseline.json").read_text())
QUALITY = {name: one["value"] for name, one in BASELINE["quality"].items()}
TIMES = {name: one["wall"] for name, one in BASELINE["times"].items()}
NEAREST = ["--only", "nearest", "--rounds", "1", "--gate"]


@pytest.fixture(autouse=True)
def _keep_the_threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_the_baseline_passes_its_own_gate():
    assert judge(QUALITY, TIMES, BASELINE) == ([], [])


@pytest.mark.parametrize("name", QUALITY)
def test_a_worse_figure_fails_and_one_within_its_tolerance_passes(name: str):
    one = BASELINE["quality"][name]
    for share, fails in ((0.9, 0), (1.1, 1), (math.nan, 1), (-0.9, 0), (-1.1, one["both"])):
        value = one["value"] + share * one["tolerance"]
        assert len(judge(QUALITY | {name: value}, TIMES, BASELINE).failures) == fails


@pytest.mark.parametrize("name", QUALITY)
def test_the_committed_tolerance_is_the_one_that_the_gate_gives_a_reason_for(name: str):
    one = BASELINE["quality"][name]
    assert one == held(name, one["value"])
    assert len(one["why"]) > 10


def test_energies_are_held_to_a_hundredth_of_a_thousandth_and_a_descent_to_a_thousandth():
    for name, share in (("energy at a fixed start", 1e-5), ("energy after 60 steps", 1e-3)):
        one = BASELINE["quality"][name]
        assert one["tolerance"] == pytest.approx(share * one["value"])


def test_an_absent_figure_fails_unless_it_needs_an_optional_package():
    for name, one in BASELINE["quality"].items():
        rest = {n: v for n, v in QUALITY.items() if n != name}
        assert bool(judge(rest, TIMES, BASELINE).failures) != one["optional"]


def test_time_only_warns():
    slow = {name: 2 * SLOWER * wall for name, wall in TIMES.items()}
    failures, warnings = judge(QUALITY, slow, BASELINE)
    assert failures == []
    assert len(warnings) == len(TIMES) > 0


def test_the_command_passes_its_gate_and_fails_where_what_is_computed_is_broken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    peers.main(NEAREST)
    assert "0 worse" in capsys.readouterr().out
    right = peers_rows.nearest
    monkeypatch.setattr(peers_rows, "nearest", lambda *given: (right(*given) + 1) % 1500)
    with pytest.raises(SystemExit) as end:
        peers.main(NEAREST)
    assert end.value.code == 1
    assert "WORSE  nearest Warp - SciPy" in capsys.readouterr().out


@pytest.mark.slow
def test_the_energies_of_fixed_inputs_are_those_of_the_baseline():
    quality = QUALITY | peers_rows.energies()
    assert judge(quality, {}, BASELINE).failures == []


def test_a_tool_that_is_not_there_is_told_in_one_line(capsys: pytest.CaptureFixture[str]):
    for _ in range(2):
        assert peers_tools.absent("no_such_package")
    assert capsys.readouterr().out == "no_such_package is not installed: its rows are left out\n"


def test_outlines_are_the_sides_between_a_front_and_a_back():
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]).numpy()
    front = torch.tensor([True, False, False, False]).numpy()
    flags = peers_tools.outline(faces, front)
    assert flags[0].all()
    assert flags.sum() == 6  # its three sides, each seen from both triangles
