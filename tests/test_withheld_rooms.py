"""What `benchmarks/withheld.py` does with seeds that have no room."""

import sys
from pathlib import Path

import pytest

from mover_bench.rooms.known import NoRoomError

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import withheld


def test_a_seed_without_a_room_is_told_and_the_next_one_follows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def no_room(seed: int, *_: object) -> None:
        raise NoRoomError(f"seed {seed}: no step: it stands in the way")

    monkeypatch.setattr(withheld, "noisy_room", no_room)
    monkeypatch.setattr(sys, "argv", ["withheld.py", "--sets", "withheld-step", "--seeds", "3,4"])
    withheld.main()
    told = capsys.readouterr().out
    assert "withheld-step 3: left out, there is no such room: seed 3: no step" in told
    assert "withheld-step 4: left out" in told
    assert "0 of 0 found, 0 false in 0 rooms" in told
